"""Subsequence dynamic time warping against hand-computed paths and a plain reference."""

import numpy as np

from isaacgymenvs_lite.evaluation.pose_error import align


def plain_alignment(cost, off_tempo=0.0):
    """(mean cost, advance) of one (T, S) matrix, cell by cell in plain Python."""
    rows, columns = cost.shape
    best = {}
    for t in range(rows):
        for s in range(columns):
            ways = [(0.0, 0, 0)] if t == 0 else []
            for dt, ds in ((1, 0), (0, 1), (1, 1)):
                if (t - dt, s - ds) in best:
                    total, cells, advance = best[t - dt, s - ds]
                    pays = 0.0 if dt == ds else off_tempo
                    ways.append((total + pays, cells, advance + ds))
            total, cells, advance = min(ways)
            best[t, s] = (total + cost[t, s], cells + 1, advance)
    total, cells, advance = min(best[rows - 1, s] for s in range(columns))
    return total / cells, advance


def align_one(cost, **options):
    cost = np.asarray(cost, dtype=float)[:, :, None]
    found = align(cost, *np.array(cost.shape[:2])[:, None], **options)
    return float(found.mean_cost[0]), int(found.advance[0])


def test_two_by_three_computed_by_hand():
    # (0, 0) -> (1, 1) costs 1 + 2; staying in a column costs 1 + 4, 5 + 2 or 4 + 3.
    assert align_one([[1, 5, 4], [4, 2, 3]]) == ((1.0 + 2.0) / 2, 1)


def test_step_along_the_reference_is_a_cell_of_its_own():
    # (0, 0) (1, 1) (1, 2) (2, 3): 0 + 1 + 1 + 0 over four cells.
    cost = [[0, 9, 9, 9], [9, 1, 1, 9], [9, 9, 9, 0]]
    assert align_one(cost) == (0.5, 3)


def test_of_equally_cheap_paths_the_one_with_fewer_cells_counts():
    # (0, 0) (1, 1) (1, 2) (2, 3) and (0, 2) (1, 2) (2, 3) both cost 4.
    cost = [[0, 9, 2, 9], [9, 2, 2, 9], [9, 9, 9, 0]]
    assert align_one(cost) == (4.0 / 3.0, 1)


def test_then_the_one_that_advances_least():
    # All cells cost the same: staying at one reference frame is as cheap as following it.
    assert align_one(np.ones((4, 5))) == (1.0, 0)


def test_path_pays_for_leaving_the_tempo_of_the_reference():
    # Staying in column 0 costs nothing but two steps; going on costs 0.25 in each of two cells.
    cost = [[0, 9, 9], [0, 0.25, 9], [0, 9, 0.25]]
    assert align_one(cost, off_tempo=0.125) == (2 * 0.125 / 3, 0)
    assert align_one(cost, off_tempo=0.5) == (2 * 0.25 / 3, 2)


def test_where_all_frames_are_alike_a_path_that_pays_keeps_the_tempo_of_the_reference():
    assert align_one(np.ones((4, 5)), off_tempo=0.125) == (1.0, 3)
    assert align_one(np.ones((1, 5)), off_tempo=0.125) == (1.0, 0)  # nothing for the first cell


def test_start_and_end_in_the_reference_are_free():
    for start in (0, 3, 6):
        cost = np.ones((4, 10))
        cost[np.arange(4), start + np.arange(4)] = 0.0
        assert align_one(cost) == (0.0, 3)


def test_equals_the_plain_recursion():
    rng = np.random.default_rng(0)
    for _ in range(60):
        shape = rng.integers(1, 9, size=2)
        # Whole numbers make ties; their sums are exact, so that every number must be equal.
        whole = rng.integers(0, 4, size=shape).astype(float)
        assert align_one(whole) == plain_alignment(whole)
        # Both sum along the path in the same order, hence equal to the last bit as well.
        real = rng.random(shape)
        assert align_one(real) == plain_alignment(real)
        assert align_one(whole, off_tempo=1.0) == plain_alignment(whole, 1.0)
        assert align_one(real, off_tempo=0.25) == plain_alignment(real, 0.25)


def test_different_lengths_in_a_batch_equal_one_by_one():
    rng = np.random.default_rng(0)
    cost = rng.random((9, 7, 6))
    lengths = np.array([9, 1, 4, 7, 2, 8])
    expected = []
    for e, rows in enumerate(lengths):
        expected.append(plain_alignment(cost[:rows, :, e])[0])
        cost[rows:, :, e] = np.nan  # what comes after the end may be anything
    np.testing.assert_array_equal(align(cost, lengths, np.full(6, 7)).mean_cost, expected)


def test_more_columns_repeat_the_reference():
    cost = np.random.default_rng(0).random((6, 4, 3))
    found = align(cost, np.full(3, 6), np.array([4, 11, 3]))
    for e, columns in enumerate((4, 11, 3)):
        tiled = np.tile(cost[:, :, e], (1, 3))[:, :columns]
        assert found.mean_cost[e] == plain_alignment(tiled)[0]
