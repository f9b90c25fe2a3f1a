from isaacgymenvs_lite.config.train_params import fit_minibatch


def test_nearest_divisor_in_ratio():
    for batch, wish, expected in [
        (65536, 32768, 32768),  # fits: 4096 environments x 16 steps, as published
        (1024, 32768, 1024),  # 64 x 16: more than there is
        (16, 32768, 16),  # one environment
        (1000, 300, 250),  # 300/250 = 1.2, 500/300 = 1.67
        (1072, 512, 536),  # 67 x 16 = 2^4 x 67: 536/512 = 1.05
        (4, 3, 4),  # 4/3 = 1.33, 3/2 = 1.5
        (7, 3, 7),  # prime: 7/3 = 2.33, 3/1 = 3
    ]:
        assert fit_minibatch(batch, wish) == expected


def test_multiples_of_the_sequence_length():
    assert fit_minibatch(1024, 300, multiple_of=4) == 256
    assert fit_minibatch(48, 6, multiple_of=8) == 8
    # 36 samples in sequences of 4: 4, 12, 36. The wish of 18 divides, but cuts sequences.
    assert fit_minibatch(36, 18, multiple_of=4) == 12  # 18/12 = 1.5 < 36/18 = 2


def test_result_always_divides():
    for batch in range(1, 200):
        for wish in (1, 7, 32, 500):
            assert batch % fit_minibatch(batch, wish) == 0
