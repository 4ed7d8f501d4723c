"""Boosted trees find what depends on a feature, and nothing in noise."""

import numpy as np

from pipeline.estimation.terms import bin_features, boost

SEEN, ALL = slice(0, 1500), 2000


def explain(target: np.ndarray, features: np.ndarray) -> float:
    """Share of the variance on unseen rows that trees predict."""
    bins = bin_features(features)
    unseen = target[SEEN.stop :]
    rest = unseen - boost(bins[SEEN], target[SEEN], bins[SEEN.stop :])
    return 1.0 - float(np.var(rest) / np.var(unseen))


def test_trees_find_steps_bends_and_products_on_rows_they_have_not_seen() -> None:
    draw = np.random.default_rng(1)
    features = draw.normal(size=(ALL, 6))
    features[:, 5] = 3.0
    noise = 0.3 * draw.normal(size=ALL)
    one, two = features[:, 0], features[:, 3]
    assert explain(np.where(one > 0.4, 1.0, -1.0) + noise, features) > 0.85
    assert explain(np.sin(2.0 * two) + noise, features) > 0.75
    assert explain(one * two + noise, features) > 0.6


def test_trees_explain_none_of_noise() -> None:
    draw = np.random.default_rng(2)
    assert explain(draw.normal(size=ALL), draw.normal(size=(ALL, 6))) < 0.02


def test_too_few_rows_to_split_are_told_their_mean() -> None:
    features = np.linspace(0.0, 1.0, 40)[:, None]
    target = np.where(features[:, 0] > 0.5, 1.0, 0.0)
    bins = bin_features(features)
    assert np.allclose(boost(bins, target, bins[:3]), 0.5)
