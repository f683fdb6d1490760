"""What a replay buffer computes with rows of arrays.

B batch, n steps of a return.
"""

import numpy as np


def as_row(array: np.ndarray, values: object) -> np.ndarray:
    """
    :param array: ``(rows, *shape)``
    :param values: what is to become one of its rows
    :return: the values as such a row, ``shape``
    :raises ValueError: if they do not fit
    """
    row: np.ndarray = np.empty_like(array[0])
    row[...] = values
    return row


def same_bytes(one: np.ndarray, other: np.ndarray) -> bool:
    """
    Unlike ``==``: NaN is itself, and 0.0 is not -0.0.

    :param one: an array whose last axis, if it has one, is contiguous
    :param other: another, of the same type
    """
    return np.array_equal(np.atleast_1d(one).view(np.uint8), np.atleast_1d(other).view(np.uint8))


def n_step_returns(rewards: np.ndarray, ends: np.ndarray, gamma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Sum the rewards up to the first end, or all n.

    :param rewards: ``(B, n)``
    :param ends: steps after which nothing may be added, ``(B, n)``
    :param gamma: discount
    :return: steps that were taken ``(B,)``, discounted sums of their rewards ``(B, 1)``, and discounts of the values after
        them ``(B, 1)``
    """
    steps = np.arange(rewards.shape[1])
    taken = np.where(ends.any(axis=1), ends.argmax(axis=1) + 1, len(steps))
    mask = steps < taken[:, None]
    discounted = rewards * gamma ** steps.astype(np.float32) * mask
    return taken, discounted.sum(axis=1, keepdims=True), gamma ** taken[:, None].astype(np.float32)
