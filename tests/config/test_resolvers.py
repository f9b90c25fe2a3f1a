import pytest
import torch
from omegaconf import OmegaConf
from omegaconf.errors import InterpolationResolutionError

from isaacgymenvs_lite.config.resolvers import register_resolvers


@pytest.fixture(autouse=True)
def _registered():
    register_resolvers()


def resolve(expression: str, **values):
    return OmegaConf.create({**values, "result": expression}).result


def test_semantics():
    for expression, expected in [
        ("${eq:gpu,gpu}", True),
        ('${eq:"cpu",gpu}', False),
        ("${eq:'',''}", True),
        ("${contains:cuda,cuda:0}", True),
        ('${contains:"cuda",cpu}', False),
        ("${contains:'',cpu}", True),
        ("${if:True,1,2}", 1),
        ("${if:False,1,2}", 2),
        ("${if:'',1,2}", 2),
        ("${if:'False',1,2}", 1),  # text, hence true: as in Python
        ("${if:x.pth,True,False}", True),
        ("${resolve_default:4096,''}", 4096),
        ("${resolve_default:4096,0}", 0),
        ("${resolve_default:4096,null}", None),
        ("${resolve_default:Ant,mine}", "mine"),
    ]:
        result = resolve(expression)
        assert result == expected
        assert type(result) is type(expected)


def test_empty_mapping_is_false_and_any_other_is_true():
    assert resolve("${if:${node},60,5}", node={}) == 5
    assert resolve("${if:${node},60,5}", node={"enabled": False}) == 60


def test_eq_and_contains_need_text():
    for expression in ("${eq:1,1}", "${contains:1,cpu}"):
        with pytest.raises(InterpolationResolutionError):
            resolve(expression)


@pytest.mark.parametrize(("available", "expected"), [(True, "cuda:0"), (False, "cpu")])
def test_default_rl_device(monkeypatch, available, expected):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: available)
    assert resolve("${default_rl_device:}") == expected


def test_registering_beside_another_package_that_took_the_names():
    OmegaConf.register_new_resolver("eq", lambda a, b: "theirs", replace=True)
    register_resolvers()
    register_resolvers()
    assert resolve("${eq:a,A}") is True
