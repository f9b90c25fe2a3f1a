"""Domain randomisation in a task: models that differ, when, and that physics feels it."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch

N = 64


def _entry(low: float, high: float, **more: str | bool | int) -> str:
    given = {"range": [low, high], "operation": "scaling", "distribution": "uniform", **more}
    return str(given).replace("'", "").replace("True", "true")


@pytest.fixture
def ant(make_task):
    """Return `ant(*overrides)`: 64 ants, randomised, with nothing that the overrides do not add."""

    def make(*overrides: str):
        params = "task.task.randomization_params"
        bare = (f"~{params}.observations", f"~{params}.actions", f"~{params}.actor_params.ant")
        added = [f"++{params}.{override}" for override in overrides]
        start = ["task=Ant", "task.task.randomize=True", *bare]
        return make_task(*start, f"+{params}.actor_params.ant={{}}", *added, num_envs=N)

    return make


def _field(task, name: str) -> np.ndarray:
    return task.simulation.expand(name)


def test_the_published_settings_of_every_task_work(make_task, caplog) -> None:
    task = make_task("task=Ant", "task.task.randomize=True", num_envs=N)
    task.reset()
    observed = task.step(task.zero_actions())[0]["obs"]
    assert observed.isfinite().all()
    masses = _field(task, "body_mass") / task.simulation.model.body_mass.clip(1e-9)
    assert masses[:, 1:].min() >= 0.5
    assert masses[:, 1:].max() <= 1.5
    # Each body of each environment by itself.
    assert len(np.unique(masses[:, 1:].round(9))) == N * 9
    damping = _field(task, "dof_damping")[:, 6:]
    assert damping.min() >= 0.05
    assert damping.max() <= 0.15
    assert damping.std() > 0.02


def test_inertia_follows_the_mass_and_constants_are_updated(ant) -> None:
    task = ant(f"actor_params.ant.rigid_body_properties={{mass: {_entry(0.5, 1.5)}}}")
    model = task.simulation.model
    ratio = _field(task, "body_mass")[:, 1:] / model.body_mass[1:]
    inertia = _field(task, "body_inertia")[:, 1:] / model.body_inertia[1:]
    assert inertia == pytest.approx(np.repeat(ratio[..., None], 3, axis=-1))
    subtree = task.simulation.expand("body_subtreemass")[:, 1]
    assert subtree == pytest.approx(_field(task, "body_mass")[:, 1:].sum(axis=1))


def test_setup_only_is_drawn_once_and_the_rest_at_its_frequency(ant) -> None:
    task = ant(
        "frequency=3",
        f"actor_params.ant.rigid_body_properties={{mass: {_entry(0.5, 1.5, setup_only=True)}}}",
        f"actor_params.ant.dof_properties={{damping: {_entry(0.5, 1.5)}}}",
    )
    mass, damping = _field(task, "body_mass").copy(), _field(task, "dof_damping").copy()
    task.reset()
    assert (_field(task, "dof_damping") == damping).all()  # no step was made since
    for _ in range(3):
        task.step(task.zero_actions())
    some = torch.tensor([1, 5])
    task.randomize_buf[:] = 3
    task.reset_idx(some)
    changed = (_field(task, "dof_damping") != damping).any(axis=1)
    assert changed.nonzero()[0].tolist() == [1, 5]
    assert (_field(task, "body_mass") == mass).all()
    assert task.randomize_buf[some].tolist() == [0, 0]


def test_draws_do_not_pile_up(ant) -> None:
    task = ant("frequency=1", f"actor_params.ant.dof_properties={{damping: {_entry(0.9, 1.1)}}}")
    everyone = torch.arange(N)
    for _ in range(30):
        task.randomize_buf[:] = 1
        task.reset_idx(everyone)
    assert _field(task, "dof_damping")[:, 6:].min() >= 0.09 - 1e-12
    assert _field(task, "dof_damping")[:, 6:].max() <= 0.11 + 1e-12


def _slowed_by_friction(make_task, coefficient: float) -> float:
    """Return by how much ants slow down that slide over the ground (m/s^2)."""
    params = "task.task.randomization_params.actor_params.ant"
    entry = _entry(coefficient, coefficient)
    group = f"++{params}.rigid_shape_properties={{friction: {entry}}}"
    task = make_task("task=Ant", "task.task.randomize=True", group, num_envs=16)
    geoms = np.flatnonzero(task.simulation.model.geom_bodyid > 0)
    friction = _field(task, "geom_friction")[..., 0]
    assert friction[:, geoms] == pytest.approx(0.5 * (coefficient + 1.0))
    # MuJoCo takes the larger of two coefficients: the ground must not have one.
    assert friction[:, task.simulation.model.geom("floor").id].max() < 1e-4
    n = task.num_envs
    root = task.initial_root.repeat(n, 1)
    root[:, 2], root[:, 7] = 0.37, 3.0  # m, m/s: on their feet
    pos = task.initial_dof_pos.repeat(n, 1)
    task.simulation.write_state(torch.arange(n), root, pos, torch.zeros_like(pos))
    for _ in range(12):
        task.simulation.step()
    return (3.0 - task.simulation.root_states[:, 7].mean().item()) / (12 * 0.0166)


def test_friction_is_the_mean_of_both_shapes_and_felt(make_task) -> None:
    # Coulomb's law, as far as the feet meet the ground: they bounce.
    torch.manual_seed(0)
    ratio = _slowed_by_friction(make_task, 0.2) / _slowed_by_friction(make_task, 1.0)
    assert ratio == pytest.approx(0.6, rel=0.15)


def test_gravity_is_drawn_for_each_axis_and_the_same_for_all(ant) -> None:
    task = ant(
        "sim_params={gravity: {range: [0, 0.4], operation: additive, distribution: gaussian}}"
    )
    gravity = _field(task, "opt.gravity")
    assert (gravity == gravity[0]).all()
    change = gravity[0] - task.simulation.model.opt.gravity
    assert (np.abs(change) > 0).all()
    assert np.abs(change).max() < 2.4  # six standard deviations
    assert len(np.unique(change)) == 3


def test_noise_is_in_what_the_policy_sees_and_not_in_the_state(make_task) -> None:
    noise = "{range: [0, 0.1], operation: additive, distribution: gaussian}"
    task = make_task(
        "task=Cartpole",
        "task.task.randomize=True",
        f"++task.task.randomization_params.observations={noise}",
        "task.env.asymmetric_observations=True",
        num_envs=512,
    )
    task.reset()
    observed, rewards, _, _ = task.step(task.zero_actions())
    difference = observed["obs"] - observed["states"]
    assert difference.std().item() == pytest.approx(0.1, rel=0.1)
    # The reward is that of the true state.
    truth = 1.0 - observed["states"][:, 2].square()
    assert (rewards - truth).abs().max() < 0.05


def test_noise_on_actions_reaches_the_motors(make_task, controls_of) -> None:
    noise = "{range: [0, 0.1], operation: additive, distribution: gaussian}"
    task = make_task(
        "task=Cartpole",
        "task.task.randomize=True",
        f"++task.task.randomization_params.actions={noise}",
        num_envs=512,
    )
    controls = controls_of(task)
    task.step(task.zero_actions())
    assert (controls[0] / 400.0).std().item() == pytest.approx(0.1, rel=0.15)


def test_the_published_settings_of_the_imitating_humanoids(make_task, walk_clip, caplog) -> None:
    """What their file says, without its schedule: all of the humanoid differs, drives included."""
    for name in ["HumanoidAMP", "HumanoidASE", "HumanoidAMPHands"]:
        caplog.set_level(logging.WARNING)
        params = "task.task.randomization_params"
        humanoid = f"{params}.actor_params.humanoid"
        scheduled = (
            f"{params}.sim_params.gravity",
            f"{humanoid}.rigid_body_properties.mass",
            *(f"{humanoid}.rigid_shape_properties.{key}" for key in ("friction", "restitution")),
            *(f"{humanoid}.dof_properties.{k}" for k in ("damping", "stiffness", "lower", "upper")),
        )
        caplog.clear()
        task = make_task(
            f"task={name}",
            "train=HumanoidASEPPO" if name == "HumanoidASE" else "train=HumanoidAMPPPO",
            f"task.env.motion_file={walk_clip}",
            "task.task.randomize=True",
            *(f"~{entry}.schedule" for entry in scheduled),
            num_envs=N,
        )
        model = task.simulation.model
        masses = _field(task, "body_mass")[:, 1:] / model.body_mass[1:]
        gains = _field(task, "actuator_gainprm")[..., 0] / model.actuator_gainprm[:, 0]
        dampings = _field(task, "actuator_biasprm")[..., 2] / model.actuator_biasprm[:, 2]
        for values in (masses, gains, dampings):
            # Each number of each environment by itself.
            assert values.shape[1] == values[0].size > 14
            assert len(np.unique(values.round(9))) == values.size
            assert 0.5 <= values.min() < 0.52
            assert 1.48 < values.max() <= 1.5
        friction = _field(task, "geom_friction")[..., 0][:, model.geom_bodyid > 0]
        assert 0.85 <= friction.min() < 0.9  # the mean with the ground's
        limits = _field(task, "jnt_range")[:, [model.joint("right_knee").id], 1]
        assert limits.std() == pytest.approx(0.01, rel=0.4)
        assert (_field(task, "opt.gravity")[0] != model.opt.gravity).all()
        said = [record.message for record in caplog.records if "no counterpart" in record.message]
        assert len(said) == 1
        for left_out in ("shape_properties.restitution", "dof_properties.lower of ball joints"):
            assert left_out in said[0]
        assert "stiffness" not in said[0]


def test_randomised_drives_of_ball_joints_turn_to_far_targets(make_task, walk_clip) -> None:
    """Past half a turn MuJoCo's own servos would turn back, see `set_actuators`."""
    task = make_task(
        "task=HumanoidAMP",
        f"task.env.motion_file={walk_clip}",
        "task.task.randomize=True",
        "task.task.randomization_params.frequency=1",
    )
    gains, biases = (_field(task, f"actuator_{name}prm") for name in ("gain", "bias"))
    assert (gains[..., 0] != -biases[..., 1]).all()
    assert gains[..., 0] == pytest.approx(-biases[..., 1])


def test_the_schedule_of_the_published_settings_sets_in(make_task, walk_clip) -> None:
    task = make_task(
        "task=HumanoidAMP",
        f"task.env.motion_file={walk_clip}",
        "task.task.randomize=True",
        num_envs=N,
    )
    task.reset()
    damping = _field(task, "actuator_biasprm")[..., 2]
    assert damping == pytest.approx(np.tile(task.simulation.model.actuator_biasprm[:, 2], (N, 1)))
    task.control_steps = 750  # two simulator calls each: half of the way
    task.randomize_buf[:] = 600
    task.reset()
    factors = damping / task.simulation.model.actuator_biasprm[:, 2]
    assert 0.75 <= factors.min() < 0.77
    assert 1.23 < factors.max() <= 1.25


_ACTORS = "task.task.randomization_params.actor_params"


def _object_bodies(task) -> np.ndarray:
    model = task.simulation.model
    return (np.arange(model.nbody) == model.body("object").id)[1:]


def test_a_hand_and_its_object_are_drawn_from_their_own_ranges(make_task) -> None:
    task = make_task(
        "task=ShadowHand",
        "task.task.randomize=True",
        f"{_ACTORS}.object.rigid_body_properties.mass.range=[2.0,3.0]",
        f"{_ACTORS}.object.rigid_shape_properties.friction.range=[0.2,0.4]",
        num_envs=N,
    )
    model, held = task.simulation.model, _object_bodies(task)
    has_mass = model.body_mass[1:] > 0.0
    is_held = model.geom_bodyid == model.body("object").id
    is_hand = ~is_held & (model.geom_bodyid > 0)
    friction = []
    for _ in range(2):
        mass = _field(task, "body_mass")[:, 1:] / model.body_mass[1:].clip(1e-9)
        friction.append(_field(task, "geom_friction")[..., 0].copy())
        for values, low, high in (
            (mass[:, held], 2.0, 3.0),
            (mass[:, has_mass & ~held], 0.5, 1.5),
            (2.0 * friction[-1][:, is_held] - 1.0, 0.2, 0.4),  # means with 1
            (2.0 * friction[-1][:, is_hand] - 1.0, 0.7, 1.3),
        ):
            # 64 draws at least
            assert low - 1e-9 <= values.min() < low + 0.15 * (high - low)
            assert high - 0.15 * (high - low) < values.max() <= high + 1e-9
        task.randomize_buf[:] = 720
        task.reset()
    assert (friction[0][:, is_held] != friction[1][:, is_held]).mean() > 0.9
    assert (friction[0][:, is_hand] != friction[1][:, is_hand]).mean() > 0.9


@pytest.fixture
def scaled(make_task):
    """Return 16 tasks whose blocks have other sizes and which differ in nothing else."""
    task = make_task(
        "task=ShadowHand",
        "task.task.randomize=True",
        f"~{_ACTORS}.hand",
        *(f"~task.task.randomization_params.{part}" for part in ("sim_params", "actions")),
        f"~{_ACTORS}.object.rigid_body_properties",
        f"{_ACTORS}.object.scale.range=[0.9,1.1]",
        "task.env.useRelativeControl=True",  # zero actions hold the hand
        "task.env.fallDistance=1e9",
        num_envs=16,
    )
    task.reset()
    return task


def _let_go(task, start: tuple[float, float, float]) -> torch.Tensor:
    """Put the blocks over a flat hand or elsewhere; return their states (N, 13) a second later."""
    sim, n = task.simulation, task.num_envs
    zeros, states = torch.zeros(n, len(sim.dof_names)), torch.zeros(n, 1, 13)
    sim.write_state(torch.arange(n), torch.zeros(n, 13), zeros, zeros)
    states[:, 0, :3], states[..., 6] = torch.tensor(start), 1.0
    sim.write_object_states(torch.arange(n), torch.tensor([0]), states)
    task.prev_targets.zero_()
    for _ in range(60):
        task.reset_buf.zero_()
        task.step(task.zero_actions())
    return sim.object_states[:, 0]


def test_a_scaled_object_is_larger_but_not_heavier(scaled) -> None:
    model, held = scaled.simulation.model, _object_bodies(scaled)
    is_held = model.geom_bodyid == model.body("object").id
    sizes = _field(scaled, "geom_size")
    assert (sizes == model.geom_size)[:, ~is_held].all()
    scales = sizes[:, is_held, 0] / 0.025
    assert sizes[:, is_held][:, 0] == pytest.approx(np.repeat(0.025 * scales, 3, axis=1))
    assert 0.9 <= scales.min() < 0.94
    assert 1.06 < scales.max() <= 1.1
    for field in ("body_mass", "body_inertia"):
        assert (_field(scaled, field)[:, 1:][:, held] == getattr(model, field)[1:][held]).all()
    rested = _let_go(scaled, (1.0, 1.0, 0.03))
    # Contacts with the floor give way by a fraction of a millimetre.
    assert rested[:, 2].numpy() == pytest.approx(0.025 * scales[:, 0], abs=2e-4)


def test_scaled_objects_rest_on_bodies_of_several_shapes(scaled) -> None:
    """The palm has two boxes; contacts that MuJoCo finds late make an object tremble."""
    rested = _let_go(scaled, (-0.011, -0.328, 0.53))
    assert (rested[:, 2] > 0.5).all()
    assert rested[:, 7:].abs().max() < 0.05


def test_dampings_of_tendons_are_drawn_and_stiffnesses_are_not(make_task, caplog) -> None:
    caplog.set_level(logging.WARNING)
    task = make_task("task=ShadowHand", "task.task.randomize=True", num_envs=N)
    factors = _field(task, "tendon_damping") / task.simulation.model.tendon_damping
    assert factors.shape == (N, 4)
    assert len(np.unique(factors.round(9))) == 4 * N
    assert 0.3 <= factors.min() < 0.33
    assert 2.7 < factors.max() <= 3.0
    # Loguniform: the deviation of the logarithm is log(10) / sqrt(12).
    assert np.log(factors).mean() == pytest.approx(np.log(0.9) / 2.0, abs=0.12)
    (said,) = (text for text in caplog.messages if "no counterpart" in text)
    assert said.endswith(": actor_params.hand.tendon_properties.stiffness")


def test_the_table_of_trifinger_has_the_mean_friction(make_task) -> None:
    task = make_task("task=Trifinger", num_envs=N)
    model = task.simulation.model
    friction = _field(task, "geom_friction")[..., 0]
    drawn = {name: friction[:, model.geom(name).id] for name in ("table", "object")}
    # Means of 0.1 times U(0.5, 1.5), or of U(0.7, 1.3), and 1
    for name, low, high in (("table", 0.525, 0.575), ("object", 0.85, 1.15)):
        assert low - 1e-9 <= drawn[name].min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < drawn[name].max() <= high
    assert model.geom("table").priority[0] > model.geom("object").priority[0]
    fingers = [i for i in range(model.ngeom) if model.geom(i).name.startswith("finger_")]
    assert (friction[:, fingers] == 1.0).all()
