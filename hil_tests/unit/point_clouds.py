"""Clouds for the tests of detection."""

import numpy as np


def cloud_of(*columns):
    return np.ascontiguousarray(np.column_stack(np.broadcast_arrays(*columns)), dtype=np.float32)


def as_set(cloud):
    return sorted(map(tuple, cloud.tolist()))


def spoilt(rng, cloud):
    """The cloud among rows that no filter may take; how many of these are far off, and how many not finite."""
    bad = np.array(
        [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [np.nan, np.inf, 1], [128, 0, 0], [0, -3e38, 0], [0, 0, 129]],
        dtype=np.float32,
    )
    mixed = np.concatenate((cloud, bad))
    places = np.sort(rng.permutation(len(mixed))[: len(bad)])
    result = np.empty_like(mixed)
    result[np.setdiff1d(np.arange(len(mixed)), places)] = cloud
    result[places] = bad
    return result, 3, 4
