import logging
from typing import Any

import pytest

from isaacgymenvs_lite import schema
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.train_params import KnownNames, prepare_train_params
from isaacgymenvs_lite.errors import ConfigError
from tests.tiny import ASYMMETRIC_CRITIC, CONFIG

AMP_KEYS = ("amp_minibatch_size",)
NAMES = KnownNames(
    algos=("a2c_continuous", "amp_continuous", "amp_agent"),
    models=("continuous_amp", "continuous_a2c_logstd"),
    networks=("amp", "actor_critic"),
    config_keys=AMP_KEYS,
)


@pytest.fixture(autouse=True)
def _no_key_logged():
    schema.LOGGED_KEYS.clear()


@pytest.fixture
def prepare(config_dir):
    def prepare_file(*overrides: str, train: str = "Published", **arguments: Any) -> dict[str, Any]:
        cfg = compose([f"train={train}", "rl_device=cpu", *overrides], config_dir)
        return prepare_train_params(cfg, **{"num_envs": 64, "seed": 1, "names": NAMES, **arguments})

    return prepare_file


def config_of(params: dict[str, Any]) -> dict[str, Any]:
    return params["config"]


def test_result_is_plain_and_complete(prepare):
    params = prepare(num_envs=64, seed=9, run_name="run_1")
    config = params["config"]
    assert type(params["network"]["mlp"]["units"]) is list
    assert params["seed"] == 9
    assert (config["device"], config["device_name"]) == ("cpu", "cpu")
    assert config["num_actors"] == 64
    assert config["full_experiment_name"] == "run_1"
    assert (config["population_based_training"], config["pbt_idx"]) == (False, None)
    assert config["reward_shaper"] == {"scale_value": 1}
    assert config["player"]["deterministic"] is True


def test_ase_file_is_completed(prepare):
    params = prepare(train="Ase", num_envs=8, seed=3)
    assert (params["seed"], params["config"]["num_actors"], params["config"]["name"]) == (
        *(3, 8),
        "Humanoid",
    )


def test_frames_limit_under_its_former_name(prepare):
    config = config_of(prepare("+train.params.config.max_steps=1000"))
    assert config["max_frames"] == 1000
    assert "max_steps" not in config
    both = config_of(
        prepare("+train.params.config.max_steps=1000", "+train.params.config.max_frames=500")
    )
    assert (both["max_frames"], "max_steps" in both) == (500, False)


def test_sequence_length_without_a_recurrent_network_is_one(prepare, caplog):
    config = config_of(prepare())
    assert config["seq_length"] == 1
    assert "seq_len" not in config
    assert "seq_len" not in caplog.text


RNN = "+train.params.network.rnn={name: lstm, units: 8, layers: 1}"


def test_sequence_length_of_a_recurrent_network_is_kept_with_a_warning(prepare, caplog):
    config = config_of(prepare(RNN, "train.params.config.seq_len=8"))
    assert config["seq_length"] == 8
    assert "seq_len" not in config
    assert "seq_len is called seq_length now: using 8" in caplog.text


def test_a_critic_alone_may_be_recurrent(prepare):
    rnn = "rnn: {name: gru, units: 8, layers: 1}, name: actor_critic"
    critic = ASYMMETRIC_CRITIC.replace("name: actor_critic", rnn).replace("32768", "100")
    words = (f"+{CONFIG}.central_value_config={critic}", f"{CONFIG}.minibatch_size=100")
    config = config_of(prepare(*words, f"{CONFIG}.seq_len=8", num_envs=25))
    assert config["seq_length"] == 8
    assert config["minibatch_size"] == 100  # of 400 samples
    assert config["central_value_config"]["minibatch_size"] == 80  # whole sequences
    with pytest.raises(ConfigError, match="seq_length 5 does not divide horizon_length 16"):
        prepare(*words, f"{CONFIG}.seq_len=5", num_envs=25)


def test_an_epoch_that_no_memory_holds_is_refused(prepare):
    with pytest.raises(
        ConfigError, match=r"an epoch has 6.4e\+12 samples, expected at most 2147483647"
    ):
        prepare("train.params.config.horizon_length=100000000000")


def test_minibatches_are_fitted_with_a_line_for_each(prepare, caplog):
    with caplog.at_level(logging.INFO):
        config = config_of(prepare(num_envs=64))
    assert (config["minibatch_size"], config["amp_minibatch_size"]) == (1024, 1024)
    assert [record.message for record in caplog.records] == [
        "minibatch_size 32768 does not divide 1024 samples (64 envs x 16 steps): using 1024",
        "amp_minibatch_size 4096 exceeds the minibatch: using 1024",
    ]


def test_minibatch_size_for_each_environment(prepare, caplog):
    overrides = (
        "~train.params.config.minibatch_size",
        "+train.params.config.minibatch_size_per_env=",
    )
    with caplog.at_level(logging.INFO):
        assert config_of(prepare(overrides[0], overrides[1] + "8"))["minibatch_size"] == 512
    # 6 x 64 = 384: 512/384 = 1.33 is nearer than 384/256 = 1.5
    assert config_of(prepare(overrides[0], overrides[1] + "6"))["minibatch_size"] == 512


def test_minibatch_of_a_recurrent_network_holds_whole_sequences(prepare, caplog):
    # 3 x 16 = 48 samples in sequences of 8: 6 divides 48, but is no multiple of 8.
    with caplog.at_level(logging.INFO):
        config = config_of(
            prepare(
                *(RNN, "train.params.config.seq_len=8", "train.params.config.minibatch_size=6"),
                num_envs=3,
            )
        )
    assert config["minibatch_size"] == 8
    assert "minibatch_size 6 is no multiple of seq_length 8: using 8" in caplog.text


def test_central_critic_is_fitted_too(prepare):
    config = config_of(prepare(f"+train.params.config.central_value_config={ASYMMETRIC_CRITIC}"))
    assert config["central_value_config"]["learning_rate"] == 1e-3
    assert config["central_value_config"]["minibatch_size"] == 1024


def test_wrong_files(prepare):
    for overrides, expected in [
        (
            ["train.params.algo.name=amp_agnt"],
            "unknown algo 'amp_agnt' (did you mean 'amp_agent'?)",
        ),
        (["train.params.network.name=x"], "unknown network 'x'; choices: actor_critic, amp"),
        (["~train.params.algo"], "'train.params.algo.name' is missing; choices: "),
        (["train.params.config.gamma=1.5"], "train.params.config.gamma: got 1.5"),
        (
            ["train.params.config.learning_rate=0"],
            "learning_rate: got 0, expected a number above 0",
        ),
        (["+train.params.config.mixed_precision2=1"], None),
        (["~train.params.config.gamma"], "'train.params.config.gamma' is missing"),
        (
            ["~train.params.config.gamma", "+train.params.config.gama=0.9"],
            "unknown key 'train.params.config.gama' (did you mean 'gamma'?)",
        ),
        (
            ["~train.params.config.minibatch_size"],
            "'train.params.config.minibatch_size' is missing (is 'amp_minibatch_size' misspelt",
        ),
        (["train.params.config.lr_schedule=adaptive"], "'train.params.config.kl_threshold' is"),
    ]:
        if expected is None:
            prepare(*overrides)
            continue
        with pytest.raises(ConfigError) as error:
            prepare(*overrides)
        assert expected in str(error.value)
        assert "\n" not in str(error.value)


def test_keys_that_nothing_reads_are_named(prepare, caplog):
    prepare("+train.params.config.unheard_of=1")
    assert "nothing reads train.params.config.unheard_of" in caplog.text


def test_soft_actor_critic_has_keys_of_its_own():
    cfg = compose(["task=AntSAC", "train=AntSAC", "rl_device=cpu"])
    config = prepare_train_params(cfg, num_envs=64, seed=1)["config"]
    assert config["device"] == "cpu"
    assert (config["batch_size"], config["actor_lr"]) == (4096, 5e-4)


def test_mistakes_in_keys_of_soft_actor_critic_are_named(caplog):
    for override, said in [
        ("~train.params.config.batch_size", "batch_size' is missing"),
        ("train.params.config.batch_size=0", "batch_size: got 0, expected .*at least 1"),
        ("+train.params.config.crtic_tau=0.1", "nothing"),
    ]:
        cfg = compose(["task=AntSAC", "train=AntSAC", "rl_device=cpu", override])
        if said == "nothing":  # beside the correct key: taken for another one
            prepare_train_params(cfg, num_envs=64, seed=1)
            assert "crtic_tau" in caplog.text
            continue
        with pytest.raises(ConfigError, match=said):
            prepare_train_params(cfg, num_envs=64, seed=1)


def test_max_iterations_and_experiment_count_in_files_without_interpolations():
    cfg = compose(["max_iterations=7", "experiment=mine"])
    cfg.train.params.config.max_epochs = 100000
    cfg.train.params.config.name = "Humanoid"
    config = prepare_train_params(cfg, num_envs=4, seed=1)["config"]
    assert (config["max_epochs"], config["name"]) == (7, "mine")


def test_broken_numbers_of_every_section_are_refused(prepare):
    for override, expected in [
        ("train.params.config.gamma=[1,2]", "gamma: got [1, 2], expected a number"),
        ("train.params.network.mlp.units=[1000000000000]", "of at most 1048576"),
        ("train.params.network.mlp.activation=[]", "activation: got [], expected one of"),
        ("+train.params.network.cnn={}", "the tasks observe one vector"),
        ("+train.params.network.mlp.initializer.gain=x", "unknown key 'gain'"),
        (
            "~train.params.network.space.continuous",
            "'train.params.network.space.continuous' is missing",
        ),
        ("+train.params.config.reward_shaper.factor=2", "unknown key 'factor'"),
    ]:
        words = [override]
        if "initializer" in override:
            words.insert(0, "train.params.network.mlp.initializer.name=const_initializer")
        with pytest.raises(ConfigError) as refused:
            prepare(*words)
        assert expected in str(refused.value)


def test_the_schedule_has_rl_games_2s_name_too(prepare):
    config = config_of(prepare("+train.params.config.schedule_type=per_minibatch"))
    assert config["schedule_type"] == "legacy"
