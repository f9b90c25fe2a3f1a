"""The modules of IsaacGymEnvs 1.5 and the names that they define, and which of them are here.

Facts: module and name lists, read off the published sources; nothing of their text.
"""

from __future__ import annotations

_TORCH_JIT_UTILS = """
    angle_axis_to_exp_map calc_heading calc_heading_quat calc_heading_quat_inv
    compute_heading_and_up compute_rot copysign euler_xyz_to_exp_map exp_map_to_angle_axis
    exp_map_to_quat get_axis_params get_basis_vector get_euler_xyz local_to_world_space
    matrix_to_quaternion my_quat_rotate normalise_quat_in_pose normalize normalize_angle quat_apply
    quat_axis quat_conjugate quat_diff_rad quat_from_angle_axis quat_from_euler_xyz quat_mul
    quat_rotate quat_rotate_inverse quat_to_angle_axis quat_to_exp_map quat_to_tan_norm quat_unit
    quaternion_to_matrix saturate scale scale_transform slerp tensor_clamp tf_apply tf_combine
    tf_inverse tf_vector to_torch torch_rand_float torch_random_dir_2 unscale unscale_np
    unscale_transform
"""

# Module below isaacgymenvs -> the names that it defines.
NAMES: dict[str, str] = {
    "": "make",
    "train": "launch_rlg_hydra preprocess_train_config",
    "learning.amp_continuous": "AMPAgent",
    "learning.amp_datasets": "AMPDataset",
    "learning.amp_models": "ModelAMPContinuous",
    "learning.amp_network_builder": "AMPBuilder DISC_LOGIT_INIT_SCALE",
    "learning.amp_players": "AMPPlayerContinuous",
    "learning.common_agent": "CommonAgent",
    "learning.common_player": "CommonPlayer",
    "learning.hrl_continuous": "HRLAgent",
    "learning.hrl_models": "ModelHRLContinuous",
    "learning.replay_buffer": "ReplayBuffer",
    "pbt.mutation": """
        get_mutation_func mutate mutate_discount mutate_eps_clip mutate_float mutate_float_min_1
        mutate_mini_epochs
    """,
    "pbt.pbt": "PbtAlgoObserver PbtParams initial_pbt_check",
    "tasks": """
        AllegroHand AllegroHandDextremeADR AllegroHandDextremeManualDR AllegroKukaRegrasping
        AllegroKukaReorientation AllegroKukaThrow AllegroKukaTwoArmsRegrasping
        AllegroKukaTwoArmsReorientation Ant Anymal AnymalTerrain BallBalance Cartpole
        FactoryTaskGears FactoryTaskInsertion FactoryTaskNutBoltPick FactoryTaskNutBoltPlace
        FactoryTaskNutBoltScrew FrankaCabinet FrankaCubeStack Humanoid HumanoidAMP
        IndustRealTaskGearsInsert IndustRealTaskPegsInsert Ingenuity Quadcopter ShadowHand Trifinger
        isaacgym_task_map resolve_allegro_kuka resolve_allegro_kuka_two_arms
    """,
    "tasks.amp.humanoid_amp_base": """
        DOF_BODY_IDS DOF_OFFSETS HumanoidAMPBase KEY_BODY_NAMES NUM_ACTIONS NUM_OBS
        compute_humanoid_observations compute_humanoid_reset compute_humanoid_reward dof_to_obs
    """,
    "tasks.amp.utils_amp.amp_torch_utils": """
        angle_axis_to_exp_map calc_heading calc_heading_quat calc_heading_quat_inv
        euler_xyz_to_exp_map exp_map_to_angle_axis exp_map_to_quat my_quat_rotate quat_to_angle_axis
        quat_to_exp_map quat_to_tan_norm slerp
    """,
    "tasks.amp.utils_amp.motion_lib": "DOF_BODY_IDS DOF_OFFSETS MotionLib",
    "tasks.ant": "Ant compute_ant_observations compute_ant_reward",
    "tasks.allegro_hand": """
        AllegroHand compute_hand_reward randomize_rotation randomize_rotation_pen
    """,
    "tasks.anymal": "Anymal compute_anymal_observations compute_anymal_reward",
    "tasks.anymal_terrain": "AnymalTerrain Terrain quat_apply_yaw wrap_to_pi",
    "tasks.ball_balance": "BallBalance compute_bbot_reward",
    "tasks.base.vec_task": "EXISTING_SIM Env SCREEN_CAPTURE_RESOLUTION VecTask",
    "tasks.cartpole": "Cartpole compute_cartpole_reward",
    "tasks.franka_cabinet": "FrankaCabinet compute_franka_reward compute_grasp_transforms",
    "tasks.franka_cube_stack": "FrankaCubeStack axisangle2quat compute_franka_reward",
    "tasks.humanoid": "Humanoid compute_humanoid_observations compute_humanoid_reward",
    "tasks.humanoid_amp": "HumanoidAMP NUM_AMP_OBS_PER_STEP build_amp_observations",
    "tasks.ingenuity": "Ingenuity compute_ingenuity_reward",
    "tasks.quadcopter": "Quadcopter compute_quadcopter_reward",
    "tasks.shadow_hand": """
        ShadowHand compute_hand_reward randomize_rotation randomize_rotation_pen
    """,
    "tasks.trifinger": """
        CuboidalObject Trifinger TrifingerDimensions compute_trifinger_observations_states
        compute_trifinger_reward default_orientation gen_keypoints lgsk_kernel random_angular_vel
        random_orientation random_orientation_within_angle random_xy random_yaw_orientation random_z
    """,
    "utils.dr_utils": """
        apply_random_samples check_buckets generate_random_samples get_bucketed_val
        get_default_setter_args get_property_getter_map get_property_setter_map
    """,
    "utils.reformat": "omegaconf_to_dict print_dict",
    "utils.rlgames_utils": """
        ComplexObsRLGPUEnv MultiObserver RLGPUAlgoObserver RLGPUEnv get_rlgames_env_creator
        multi_gpu_get_rank
    """,
    "utils.rna_util": "RandomNetworkAdversary",
    "utils.torch_jit_utils": _TORCH_JIT_UTILS,
    "utils.utils": """
        ensure_dir_exists flatten_dict get_username nested_dict_get_attr nested_dict_set_attr
        project_tmp_dir retry safe_ensure_dir_exists set_np_formatting set_seed
    """,
    "utils.wandb_utils": "WandbAlgoObserver",
}

# Modules whose names are of no interest here: packages of scripts, and what is not here.
MODULES: tuple[str, ...] = (
    *(f"pbt.experiments.{name}" for name in ("ant_pbt", "run_utils", "allegro_kuka_pbt_base")),
    *(
        f"pbt.launcher.{name}"
        for name in ("run", "run_description", "run_ngc", "run_processes", "run_slurm")
    ),
    *("tasks.dextreme.adr_vec_task", "tasks.dextreme.allegro_hand_dextreme"),
    *(
        f"tasks.allegro_kuka.allegro_kuka_{name}"
        for name in (
            *("base", "regrasping", "reorientation", "throw", "two_arms", "utils"),
            *("two_arms_regrasping", "two_arms_reorientation"),
        )
    ),
    *("tasks.allegro_kuka.generate_cuboids",),
    *(
        f"tasks.factory.factory_{name}"
        for name in (
            *("base", "control", "env_gears", "env_insertion", "env_nut_bolt"),
            *("schema_class_base", "schema_class_env", "schema_class_task"),
            *("schema_config_base", "schema_config_env", "schema_config_task"),
            *("task_gears", "task_insertion"),
            *("task_nut_bolt_pick", "task_nut_bolt_place", "task_nut_bolt_screw"),
        )
    ),
    *(
        f"tasks.industreal.industreal_{name}"
        for name in (
            *("algo_utils", "base", "env_gears", "env_pegs"),
            *("task_gears_insert", "task_pegs_insert"),
        )
    ),
    *(
        f"tasks.amp.poselib.{name}"
        for name in (
            *("fbx_importer", "generate_amp_humanoid_tpose", "mjcf_importer", "retarget_motion"),
            *("poselib.core.rotation3d", "poselib.core.tensor_utils"),
            *("poselib.skeleton.skeleton3d", "poselib.visualization.common"),
        )
    ),
    *(f"tasks.amp.utils_amp.{name}" for name in ("data_tree", "gym_util", "logger")),
)

_TERMS = "takes named quantities, returns the reward's terms; ends of episodes are another function"
_QUANTITIES = "takes named quantities"
_STAND_IN = "can be imported; using it says what to do instead"

# module.name -> what it differs in; the name is there.
OTHER: dict[str, str] = {
    "tasks.allegro_hand.compute_hand_reward": _TERMS,
    "tasks.ant.compute_ant_observations": _QUANTITIES,
    "tasks.ant.compute_ant_reward": _TERMS,
    "tasks.anymal.compute_anymal_observations": _QUANTITIES,
    "tasks.anymal.compute_anymal_reward": _TERMS,
    "tasks.ball_balance.compute_bbot_reward": _TERMS,
    "tasks.cartpole.compute_cartpole_reward": _TERMS,
    "tasks.franka_cabinet.compute_franka_reward": _TERMS,
    "tasks.franka_cabinet.compute_grasp_transforms": "knows the local grasp poses",
    "tasks.franka_cube_stack.compute_franka_reward": _TERMS,
    "tasks.humanoid.compute_humanoid_observations": _QUANTITIES,
    "tasks.humanoid.compute_humanoid_reward": _TERMS,
    "tasks.ingenuity.compute_ingenuity_reward": _TERMS,
    "tasks.quadcopter.compute_quadcopter_reward": _TERMS,
    "tasks.shadow_hand.compute_hand_reward": _TERMS,
    "tasks.trifinger.compute_trifinger_reward": _TERMS,
    "utils.dr_utils.apply_random_samples": _STAND_IN,
    "utils.dr_utils.check_buckets": _STAND_IN,
    "utils.dr_utils.get_default_setter_args": _STAND_IN,
    "utils.dr_utils.get_property_getter_map": _STAND_IN,
    "utils.dr_utils.get_property_setter_map": _STAND_IN,
    "utils.torch_jit_utils.normalise_quat_in_pose": "leaves its argument as it is",
    "utils.torch_jit_utils.to_torch": "on the CPU by default; there cuda:0",
}

# module.name -> why there is none.
ABSENT: dict[str, str] = {
    **{
        f"tasks.{name}": "a task that is not here yet"
        for name in NAMES["tasks"].split()
        if name.startswith(("AllegroHandD", "AllegroK", "Factory", "IndustReal", "resolve_"))
    },
    "pbt.pbt.PbtParams": "config.pbt_settings.read_pbt_settings",
    "tasks.anymal_terrain.Terrain": "tasks/terrain makes the ground",
    "tasks.anymal_terrain.quat_apply_yaw": "calc_heading_quat and quat_apply",
    "tasks.anymal_terrain.wrap_to_pi": "normalize_angle",
    "tasks.franka_cube_stack.axisangle2quat": "exp_map_to_quat",
    "tasks.trifinger.CuboidalObject": "constants of the module",
    "tasks.trifinger.TrifingerDimensions": "constants of the module",
    "tasks.trifinger.compute_trifinger_observations_states": "compute_obs",
    "tasks.trifinger.random_angular_vel": "no task uses it",
    "tasks.trifinger.random_orientation_within_angle": "no task uses it",
    "tasks.base.vec_task.EXISTING_SIM": "each task has a simulation of its own",
    "tasks.base.vec_task.SCREEN_CAPTURE_RESOLUTION": "pictures are drawn, no screen is captured",
}
