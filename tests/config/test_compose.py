import pytest
from hydra import compose as hydra_compose
from hydra import initialize_config_dir, version
from hydra.core.global_hydra import GlobalHydra

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import PARTS, cfg_dir

ROOT_KEYS = {
    *("task", "train", "pbt", "task_name", "experiment", "num_envs", "seed", "torch_deterministic"),
    *("max_iterations", "physics_engine", "pipeline", "sim_device", "rl_device", "num_threads"),
    *("graphics_device_id", "solver_type", "num_subscenes", "test", "checkpoint", "sigma"),
    *("multi_gpu", "wandb_activate", "wandb_group", "wandb_entity", "wandb_logcode_dir"),
    *("wandb_name", "wandb_project", "wandb_tags", "capture_video", "capture_video_freq"),
    *("capture_video_len", "force_render", "headless", "latent"),
    # ours
    *("capture_video_envs", "progress_interval", "viewer", "viewer_port"),
    *("task_checkout", "resume", "distributed_timeout_s"),
}


def message(overrides, config_dir=None) -> str:
    with pytest.raises(ConfigError) as error:
        compose(overrides, config_dir)
    text = str(error.value)
    assert "\n" not in text
    return text


def test_root_has_every_key_of_the_contract_and_no_other():
    cfg = compose()
    assert set(cfg) == ROOT_KEYS
    assert (cfg.task_name, cfg.sim_device, cfg.pipeline) == ("HumanoidAMP", "cpu", "cpu")


def test_interpolations_resolve_through_the_tree():
    cfg = compose(
        ["num_envs=24", "max_iterations=7", "experiment=mine", "checkpoint=a.pth", "seed=5"]
    )
    params = cfg.train.params
    assert cfg.task.env.numEnvs == params.config.num_actors == 24
    assert params.config.max_epochs == 7
    assert params.config.name == params.config.full_experiment_name == cfg.wandb_name == "mine"
    assert (params.seed, params.load_checkpoint, params.load_path) == (5, True, "a.pth")
    assert cfg.task.physics_engine == "physx"
    assert cfg.task.sim.use_gpu_pipeline is False
    assert compose(["pipeline=gpu"]).task.sim.use_gpu_pipeline is True


def test_sizes_follow_the_device_that_learns():
    for rl_device, sizes in [("cpu", (512, 2048, 256)), ("cuda:1", (4096, 32768, 4096))]:
        cfg = compose([f"rl_device={rl_device}"])
        config = cfg.train.params.config
        assert (cfg.task.env.numEnvs, config.minibatch_size, config.amp_minibatch_size) == sizes


def test_files_of_a_user(config_dir):
    cfg = compose(["task=Mine", "train=Published", "num_envs=3"], config_dir)
    assert cfg.task.env.numEnvs == cfg.train.params.config.num_actors == 3
    assert cfg.train.params.config.learning_rate == 5e-5
    assert cfg.task.sim.physx.num_threads == 0
    ours = compose(["task=Mine", "train=HumanoidAMPPPO"], config_dir)
    assert ours.task.env.numEnvs == 512


def test_keys_can_be_added_and_set_by_path():
    cfg = compose(["+train.params.config.weight_decay=0.1", "++task.env.motion_file=/a b/c.npy"])
    assert cfg.task.env.motion_file == "/a b/c.npy"
    assert cfg.train.params.config.weight_decay == 0.1
    assert compose(["task.env.motion_file='/a b/c=d.npy'"]).task.env.motion_file == "/a b/c=d.npy"


def test_running_hydra_job_has_no_influence_and_is_left_alone():
    version.setbase("1.2")
    before = version.getbase()
    with initialize_config_dir(str(cfg_dir()), version_base="1.2"):
        job = GlobalHydra.instance().hydra
        cfg = compose(["num_envs=3"])
        assert GlobalHydra.instance().hydra is job
        assert version.getbase() == before
        assert hydra_compose("config", ["num_envs=5"]).num_envs == 5
    assert cfg.num_envs == 3
    assert "hydra" not in cfg


def names_in(group: str) -> list[str]:
    """The names of the tasks or trainings that come with the project."""
    files = (cfg_dir() / group).glob("*.yaml")
    return sorted(path.stem for path in files if path.stem not in PARTS)


def test_unknown_task_lists_the_tasks(config_dir):
    text = message(["task=HumanoidAMPP"], config_dir)
    assert text.startswith("unknown task 'HumanoidAMPP' (did you mean 'HumanoidAMP'?); choices: ")
    assert ", ".join(sorted([*names_in("task"), "Mine"])) in text


def test_unknown_train_file_lists_the_train_files():
    text = message(["train=HumanoidAMPPO"])
    assert text.startswith(
        "unknown train file 'HumanoidAMPPO' (did you mean 'HumanoidAMPPPO'?); "
        f"choices: {', '.join(names_in('train')[:8])}"
    )
    assert text.endswith(names_in("train")[-1])


def test_task_without_a_default_train_file(config_dir):
    text = message(["task=Mine"], config_dir)
    assert "no default train file 'MinePPO'" in text
    assert "train=" in text
    own = ["Ase", "OnlyDefaults", "Published"]
    choices = sorted([*names_in("train"), *own])
    assert f"choices: {', '.join(choices)}" in text


def test_a_published_hierarchy_takes_its_low_level_without_a_plus(config_dir):
    file = config_dir / "train" / "Hrl.yaml"
    file.write_text("params: {algo: {name: hrl}, config: {llc_config: low.yaml}}\n")
    key = "train.params.config.llc_checkpoint"
    cfg = compose(["train=Hrl", f"{key}=low.pth"], config_dir)
    assert cfg.train.params.config.llc_checkpoint == "low.pth"
    assert compose(["train=Hrl"], config_dir).train.params.config.llc_checkpoint == ""
    # A file that builds on ours keeps the low level that ours names.
    file.write_text("defaults: [HumanoidASEHRLPPO]\nparams: {config: {llc_config: low.yaml}}\n")
    assert compose(["train=Hrl"], config_dir).train.params.config.llc_checkpoint is None


def test_wrong_overrides():
    for override, parts in [
        ("num_env=3", ["unknown key 'num_env' (did you mean 'num_envs'?)", "max_iterations"]),
        ("task.env.numEnv=3", ["(did you mean 'task.env.numEnvs'?)", "the keys of task.env are"]),
        ("motion_file=x", ["(did you mean 'task.env.motion_file'?)"]),
        ("a.b.c=3", ["unknown key 'a.b.c'", "+a.b.c=... adds a new one"]),
        ("seed.x=3", ["'seed' holds a value, not keys of its own"]),
        ("num_envs", ["cannot read 'num_envs'", "write key=value"]),
        ("checkpoint=a=b.pth", ["cannot read 'checkpoint=a=b.pth'", "in quotes"]),
        ("num_envs=1,2", ["'num_envs=1,2' gives several values", "--multirun"]),
        ("+seed=3", ["'seed' exists", "leave out the +"]),
        ("task=3", ["'task=3' names no file"]),
        ("pbt=pbt_defualt", ["unknown pbt 'pbt_defualt' (did you mean 'pbt_default'?)"]),
    ]:
        text = message([override])
        for part in parts:
            assert part in text


def test_broken_and_odd_files_of_a_user(config_dir):
    (config_dir / "train" / "Broken.yaml").write_text("params: [1, 2")
    assert "Broken.yaml is not valid YAML" in message(["train=Broken"], config_dir)
    (config_dir / "train" / "Dangling.yaml").write_text("defaults: [Nowhere]\n")
    assert "Nowhere" in message(["train=Dangling"], config_dir)
    (config_dir / "train" / "BadGrammar.yaml").write_text("params: {seed: '${...seed'}\n")
    assert "BadGrammar" in message(["train=BadGrammar"], config_dir)


def test_sections_that_are_values_are_one_line():
    for section in ["task.env", "task.sim", "task.task", "train.params.network"]:
        with pytest.raises(ConfigError, match=f"^{section}: got 5, expected a mapping"):
            check_config(compose(["task=Ant", f"++{section}=5"]))
