import pytest
from omegaconf import OmegaConf

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.startup_notes import cpu_defaults_note, physx_only_keys, startup_notes


def test_defaults_have_nothing_without_effect():
    assert physx_only_keys(compose()) == []


@pytest.mark.parametrize("task", ["HumanoidASE", "HumanoidHeading", "HumanoidASEGetup"])
def test_a_task_file_that_builds_on_another_has_nothing_without_effect(task):
    assert physx_only_keys(compose([f"task={task}"])) == []
    assert physx_only_keys(compose([f"task={task}", "task.env.envSpacing=1"])) == [
        "task.env.envSpacing"
    ]


@pytest.mark.parametrize("base", ["Classic", "RobotAMP"])
def test_a_task_of_a_users_own_inherits_nothing_without_effect(base, config_dir):
    file = config_dir / "task" / "Mine.yaml"
    file.write_text(f"defaults: [{base}, _self_]\nname: Mine\nenv: {{numEnvs: 4}}\n")
    words = ["task=Mine", "train=HumanoidAMPPPO"]
    assert physx_only_keys(compose(words, config_dir)) == []
    assert physx_only_keys(compose([*words, "task.env.envSpacing=1"], config_dir)) == [
        "task.env.envSpacing"
    ]


def test_keys_that_have_an_effect_are_not_named():
    assert physx_only_keys(compose(["num_threads=3", "num_envs=5", "sim_device=cpu"])) == []


def test_keys_given_on_the_command_line():
    cfg = compose(
        [
            *("solver_type=0", "graphics_device_id=1", "task.env.envSpacing=3"),
            *("task.env.plane.restitution=0.5", "task.sim.physx.rest_offset=0.1"),
        ]
    )
    assert physx_only_keys(cfg) == [
        "solver_type",
        "graphics_device_id",
        "task.env.envSpacing",
        "task.env.plane.restitution",
        "task.sim.physx.rest_offset",
    ]


def test_key_given_its_default_is_not_named():
    assert physx_only_keys(compose(["solver_type=1", "task.env.envSpacing=5"])) == []


def test_file_of_a_user_is_compared_with_ours_of_that_class(config_dir):
    # Its class is HumanoidAMP; only contact_offset differs from our HumanoidAMP.yaml.
    cfg = compose(["task=Mine", "train=Published"], config_dir)
    assert physx_only_keys(cfg) == ["task.sim.physx.* (except num_threads)"]


def test_task_that_we_ship_no_file_for(config_dir):
    file = config_dir / "task" / "Mine.yaml"
    file.write_text(file.read_text().replace("name: HumanoidAMP", "name: Other"))
    cfg = compose(["task=Mine", "train=Published"], config_dir)
    assert physx_only_keys(cfg) == ["task.sim.physx.* (except num_threads)"]


def test_sizes_that_the_cpu_made_smaller():
    note = cpu_defaults_note(compose(["rl_device=cpu"]))
    assert note == (
        "defaults for learning on a CPU (on a GPU): "
        "numEnvs 512 (4096), mlp.units 512-256 (1024-512), disc.units 512-256 (1024-512), "
        "save_frequency 100 (50), minibatch_size 2048 (32768), mini_epochs 3 (6), "
        "learning_rate 0.0002 (5e-05), lr_schedule linear (constant), "
        "amp_replay_buffer_size 200000 (1000000), amp_replay_keep_prob 0.1 (0.01), "
        "amp_batch_size 256 (512), amp_minibatch_size 256 (4096), "
        "disc_grad_penalty_final 0.2 (null), amp_input_memory 1000000 (null)"
    )
    assert cpu_defaults_note(compose(["rl_device=cuda:0"])) is None


def test_every_default_of_skills_on_a_cpu_is_named():
    """Values are compared with the two trees, by another walk through them."""
    here, there = (
        OmegaConf.to_container(compose(["task=HumanoidASE", f"rl_device={device}"]), resolve=True)
        for device in ("cpu", "cuda:0")
    )
    note = cpu_defaults_note(compose(["task=HumanoidASE", "rl_device=cpu"]))
    assert note is not None
    config, on_gpu = (tree["train"]["params"]["config"] for tree in (here, there))
    different = {key for key in config if config[key] != on_gpu[key]}
    different -= {"num_actors", "device", "device_name"}
    assert "enc_uniformity_coef" in different
    for key in different:
        assert f" {key} {'null' if config[key] is None else config[key]} (" in note


def test_a_device_in_a_users_file_is_no_default(config_dir):
    file = config_dir / "train" / "Published.yaml"
    file.write_text(file.read_text() + "    device: ${....rl_device}\n")
    cfg = compose(["rl_device=cpu", "train=Published", "num_envs=64"], config_dir)
    assert cfg.train.params.config.device == "cpu"
    assert cpu_defaults_note(cfg) is None


def test_sizes_that_the_user_gave_are_not_named(config_dir):
    note = cpu_defaults_note(compose(["rl_device=cpu", "num_envs=64"]))
    assert note is not None
    assert "numEnvs" not in note
    published = compose(["rl_device=cpu", "train=Published", "num_envs=64"], config_dir)
    assert cpu_defaults_note(published) is None


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("solver_type=0", "no effect here, PhysX or viewer only: solver_type"),
    ],
)
def test_startup_notes(override, expected):
    assert startup_notes(compose(["rl_device=cuda:0"]), "check it") == []
    notes = startup_notes(compose(["rl_device=cuda:0", override]), "check it")
    assert len(notes) == 1
    assert notes[0].startswith(expected)


def test_the_list_of_cpu_defaults_is_for_those_who_ask():
    notes = startup_notes(compose(["rl_device=cpu"]), "check it")
    assert notes == ["14 defaults are for learning on a CPU, listed by: check it"]


def test_notes_change_nothing():
    cfg = compose(["rl_device=cpu"])
    startup_notes(cfg, "check it")
    assert cfg == compose(["rl_device=cpu"])
