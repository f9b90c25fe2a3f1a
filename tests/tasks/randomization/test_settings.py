"""Checks of `randomization_params`."""

from __future__ import annotations

from typing import Any

import pytest

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.tasks.randomization.settings import AttributeSettings, read_plan

_UNIFORM = {"range": [0.5, 1.5], "operation": "scaling", "distribution": "uniform"}


def _of_actor(**groups: Any) -> dict[str, Any]:
    return {"actor_params": {"ant": groups}}


def test_everything_that_is_published_is_read() -> None:
    plan = read_plan(
        {
            "frequency": 600,
            "observations": {
                "range": [0, 0.002],
                "range_correlated": [0, 0.001],
                "operation": "additive",
                "distribution": "gaussian",
                "schedule": "constant",
                "schedule_steps": 1,
            },
            "sim_params": {"gravity": {**_UNIFORM, "schedule": "linear", "schedule_steps": 3000}},
            **_of_actor(
                color=True,
                scale={**_UNIFORM, "setup_only": True},
                rigid_body_properties={"mass": {**_UNIFORM, "setup_only": True}},
                rigid_shape_properties={"friction": {**_UNIFORM, "num_buckets": 500}},
                tendon_properties={"damping": _UNIFORM},
            ),
        },
        ["ant"],
    )
    assert plan.frequency == 600
    assert plan.observations is not None
    assert plan.observations.range_correlated == (0.0, 0.001)
    assert plan.actions is None
    assert plan.gravity is not None
    assert plan.gravity.schedule == "linear"
    assert plan.actors["ant", "rigid_body_properties", "mass"].setup_only
    assert plan.actors["ant", "rigid_shape_properties", "friction"].num_buckets == 500
    assert plan.coloured == ("ant",)
    assert plan.actors["ant", "scale", ""].operation == "scaling"


def test_mistakes_are_named() -> None:
    for params, said in [
        ({"actor_params": {"cat": {}}}, "actor_params: unknown actor 'cat'.*choices: ant"),
        (_of_actor(rigid_bodies={}), "ant: unknown property 'rigid_bodies'.*rigid_body_properties"),
        (_of_actor(dof_properties={"mass": _UNIFORM}), "dof_properties: unknown attribute 'mass'"),
        (
            _of_actor(dof_properties={"damping": {**_UNIFORM, "operation": "times"}}),
            "damping.operation: got 'times', expected one of additive, scaling",
        ),
        (
            _of_actor(dof_properties={"damping": {**_UNIFORM, "range": [1.5, 0.5]}}),
            "damping.range: got .*1.5, 0.5.*lower and an upper limit",
        ),
        (
            _of_actor(
                dof_properties={
                    "damping": {**_UNIFORM, "distribution": "loguniform", "range": [0.0, 1.0]}
                }
            ),
            "damping.range: .*above 0",
        ),
        (
            {
                "observations": {
                    "range": [0, -1],
                    "operation": "additive",
                    "distribution": "gaussian",
                }
            },
            "observations.range: .*standard deviation",
        ),
        ({"frequency": 0}, "frequency: got 0"),
        ({"sim_params": {"wind": _UNIFORM}}, "sim_params: unknown parameter 'wind'"),
        ({"actor_params": {"ant": 3}}, "actor_params.ant: got 3, expected a mapping"),
        ({"observation": {}}, "unknown entry 'observation'.*did you mean 'observations'"),
    ]:
        with pytest.raises(ConfigError, match=said):
            read_plan(params, ["ant"])


def test_schedules() -> None:
    for schedule, frames, factors in [
        (None, (0, 5), (1.0, 1.0)),
        ("linear", (0, 25, 100, 900), (0.0, 0.25, 1.0, 1.0)),
        ("constant", (0, 99, 100), (0.0, 0.0, 1.0)),
    ]:
        settings = AttributeSettings(
            range=(0.0, 1.0),
            operation="additive",
            distribution="uniform",
            schedule=schedule,
            schedule_steps=100,
        )
        assert tuple(settings.factor(frame) for frame in frames) == factors
