"""How well an answer tells objects apart, by labels."""

import numpy as np
import pytest

from edgegrasp_cli.real_scenes import compare_labels, renumbered

LABELS = np.repeat([0, 1, 2, 3], [40, 20, 20, 20])


def test_the_labels_themselves_are_all_right_whatever_their_numbers() -> None:
    answer = np.array([0, 7, 9, 4])[LABELS]
    seen = compare_labels(LABELS, answer)
    assert (seen.pixel_precision, seen.pixel_recall, seen.overlap_f) == (1.0, 1.0, 1.0)
    assert (seen.found, seen.labelled, seen.called) == (3, 3, 3)
    np.testing.assert_array_equal(renumbered(LABELS, answer), LABELS)


def test_background_that_is_called_an_object_costs_precision_and_no_recall() -> None:
    answer = np.where(np.arange(100) < 20, 8, LABELS)
    seen = compare_labels(LABELS, answer)
    assert seen.pixel_precision == seen.overlap_precision == 0.75
    assert seen.pixel_recall == seen.overlap_recall == 1.0
    assert seen.found == 3
    assert (renumbered(LABELS, answer)[:20] > 3).all()


def test_an_object_cut_in_two_keeps_its_larger_part() -> None:
    answer = np.where(np.arange(100) >= 95, 5, LABELS)  # a quarter of the last object
    seen = compare_labels(LABELS, answer)
    assert seen.overlap_recall == pytest.approx(55 / 60)
    assert (seen.found, seen.called) == (3, 4)
