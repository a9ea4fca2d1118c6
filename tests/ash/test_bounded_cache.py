import numpy as np
import torch

from ash.bounded_cache import BoundedCache, size_of
from ash.rotations import RigidTransforms


def test_what_fits_is_made_once_and_the_rest_each_time_alike():
    made = []

    def make(key: int) -> np.ndarray:
        made.append(key)
        return np.full(10, key, np.uint8)

    kept = BoundedCache(make, max_bytes=25)
    for _ in range(3):
        assert [int(kept[key][0]) for key in range(4)] == [0, 1, 2, 3]
    assert made == [0, 1, 2, 3, 2, 3, 2, 3]
    assert kept.bytes == 20


def test_every_array_of_a_value_counts():
    transforms = RigidTransforms(quats=torch.zeros(5, 4), translations=torch.zeros(5, 3))
    assert size_of(transforms) == 4 * 35
    assert size_of(np.zeros((3, 2), np.float64)) == 48
    assert size_of("text") == 0
