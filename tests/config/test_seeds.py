import random

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config, resolve_seed
from tests.config.conftest import PUBLISHED


def test_given_seed_is_shifted_by_the_rank():
    assert resolve_seed(7) == 7
    assert resolve_seed(7, rank=3) == 10
    assert resolve_seed(0, torch_deterministic=True) == 0


def test_a_train_files_own_seed_counts_unless_the_command_line_has_one(config_dir):
    for words, seed in [((), 11), (("seed=42",), 42), (("train.params.seed=null",), 42)]:
        (config_dir / "train" / "Seeded.yaml").write_text(PUBLISHED.replace("${...seed}", "11"))
        assert (
            check_config(compose(["train=Seeded", "rl_device=cpu", *words], config_dir)).seed
            == seed
        )


def test_any_seed_of_a_deterministic_run_is_42():
    assert resolve_seed(-1, torch_deterministic=True) == 42
    assert resolve_seed(-1, torch_deterministic=True, rank=2) == 44


def test_drawn_seed_does_not_depend_on_the_generators():
    drawn = set()
    for _ in range(20):
        random.seed(1)
        drawn.add(resolve_seed(-1))
    assert all(0 <= seed < 10_000 for seed in drawn)
    assert len(drawn) > 1  # twenty equal draws out of 10,000: probability 1e-76
