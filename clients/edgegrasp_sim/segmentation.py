"""How well an answer tells objects from the rest, and from each other, by labels of every pixel.

Precision, recall and F of the overlap as in Xie et al., "Unseen Object Instance Segmentation"
(T-RO 2021): objects found and labelled are matched one to one for the greatest sum of F.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from edgegrasp_camera.arrays import Float64, Int64

FOUND_F = 0.75  # F from which a labelled object counts as found, as in the paper


@dataclass(frozen=True)
class Segmentation:
    """One image against its labels. Shares are 1 if there is nothing to compare."""

    pixel_precision: float  # of the pixels called an object, whichever
    pixel_recall: float  # of the pixels labelled as an object, whichever
    overlap_precision: float  # of the pixels called an object: those on the one it is matched to
    overlap_recall: float  # of the pixels labelled as an object: the same
    overlap_f: float  # harmonic mean of the two
    found: int  # labelled objects whose own F is FOUND_F or more
    labelled: int  # objects
    called: int  # objects in the answer


def compare(labels: Int64, answer: Int64) -> Segmentation:
    """Compare an answer with labels, (R,) each: the number of each pixel's object; 0: of none."""
    called, labelled, common = _common_pixels(labels, answer)
    rows, columns, f = _matches(called, labelled, common)
    right = common[rows, columns].sum()
    precision, recall = _share(right, called.sum()), _share(right, labelled.sum())
    return Segmentation(
        pixel_precision=_share(common.sum(), called.sum()),
        pixel_recall=_share(common.sum(), labelled.sum()),
        overlap_precision=precision,
        overlap_recall=recall,
        overlap_f=2 * precision * recall / max(precision + recall, 1e-9),
        found=int((f >= FOUND_F).sum()),
        labelled=len(labelled),
        called=len(called),
    )


def renumbered(labels: Int64, answer: Int64) -> Int64:
    """The answer (R,) with the numbers of the labelled objects that its own are matched to.

    Those that are matched to none get higher numbers.
    """
    called, labelled, common = _common_pixels(labels, answer)
    rows, columns, _ = _matches(called, labelled, common)
    numbers = np.concatenate([[0], labels.max(initial=0) + 1 + np.arange(len(called))])
    numbers[rows + 1] = np.unique(labels[labels > 0])[columns]
    _, place = np.unique(np.concatenate([[0], answer]), return_inverse=True)
    return np.asarray(numbers[place[1:]])


def _common_pixels(labels: Int64, answer: Int64) -> tuple[Int64, Int64, Int64]:
    """Pixels of each object called (C,), of each labelled (L,), and of each pair (C, L)."""
    names, row = np.unique(np.concatenate([[0], answer]), return_inverse=True)
    truths, column = np.unique(np.concatenate([[0], labels]), return_inverse=True)
    pair = row[1:] * len(truths) + column[1:]
    count = np.bincount(pair, minlength=len(names) * len(truths)).reshape(len(names), -1)
    return count[1:].sum(axis=1), count[:, 1:].sum(axis=0), count[1:, 1:]


def _matches(called: Int64, labelled: Int64, common: Int64) -> tuple[Int64, Int64, Float64]:
    """Rows, columns and F (M,) of the pairs that overlap, matched for the greatest sum of F."""
    f = 2 * common / np.maximum(called[:, None] + labelled, 1)
    rows, columns = linear_sum_assignment(f, maximize=True)
    overlap = f[rows, columns] > 0
    rows, columns = rows[overlap], columns[overlap]
    return rows, columns, f[rows, columns]


def _share(part: np.integer, whole: np.integer) -> float:
    return float(part / whole) if whole else 1.0
