import numpy as np

from edgegrasp_model.ranking import objects_first


def test_each_object_has_its_best_grasp_before_any_has_a_second() -> None:
    score = np.array([0.9, 0.8, 0.7, 0.6, 0.4, 0.3])
    number = np.array([2, 2, 1, 2, 3, 1])
    order = objects_first(np.arange(6), score, number)
    assert order.tolist() == [0, 2, 1, 3, 4, 5]  # what is on 3 is not good
