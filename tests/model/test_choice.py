"""Choices among scores that rounding cannot turn."""

import numpy as np

from model.choice import NEARLY, best_along, best_by, best_first, best_of, best_rows, ranked_by


def test_the_first_of_the_nearly_equal_best_is_chosen():
    """Whatever rounding adds to scores that are equal, of any sign, along any axis."""
    for scores in ([1.0, 3.0, 2.0, 3.0], [-5.0, -1.0, -2.0, -1.0], [0.0, np.inf, 1.0, np.inf]):
        for seed in range(20):
            rounding = 1 + NEARLY / 4 * np.random.default_rng(seed).uniform(-1, 1, 4)
            rounded = np.array(scores) * rounding
            assert best_of(rounded) == 1
            assert best_along(np.column_stack([rounded, rounded[::-1]]), axis=0).tolist() == [1, 0]
            assert best_along(rounded[None], axis=1).tolist() == [1]


def test_what_is_better_by_more_than_rounding_is_chosen():
    """However little more."""
    assert best_of([1.0, 1 + 3 * NEARLY]) == 1
    assert best_first([1.0, 1 + 3 * NEARLY]).tolist() == [1, 0]


def test_an_order_keeps_nearly_equal_scores_as_they_came():
    """Best first, and of none there is an empty one."""
    for seed in range(20):
        rounding = 1 + NEARLY / 4 * np.random.default_rng(seed).uniform(-1, 1, 5)
        assert best_first([2.0, 7.0, 2.0, 0.0, 7.0] * rounding).tolist() == [1, 4, 0, 2, 3]
    assert best_first([1.0, np.inf, -np.inf, np.inf]).tolist() == [1, 3, 0, 2]
    assert best_first([]).tolist() == []


def test_best_rows_are_the_same_whatever_rounding_adds():
    """Three of five in each column, the highest first, of nearly equal ones the first."""
    scores = np.array([[2.0, -4.0], [7.0, -1.0], [2.0, -1.0], [0.0, -9.0], [7.0, -4.0]])
    for seed in range(20):
        rounding = 1 + NEARLY / 4 * np.random.default_rng(seed).uniform(-1, 1, scores.shape)
        assert best_rows(scores * rounding, 3).T.tolist() == [[1, 4, 0], [1, 2, 0]]


def test_items_are_chosen_and_ranked_by_their_scores():
    """Of those with nearly equal lengths the first one first."""
    items = ["aa", "b", "cc", "ddd", "eee"]
    assert best_by(items, lambda item: len(item) + NEARLY * (item == "eee")) == "ddd"
    assert ranked_by(items, lambda item: len(item) + NEARLY * (item == "cc")) == [
        "ddd",
        "eee",
        "aa",
        "cc",
        "b",
    ]
