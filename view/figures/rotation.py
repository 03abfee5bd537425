"""Angles between orientations, for pictures."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def angle_from_first(quat_wxyz: Array) -> Array:
    """`|log(R R_0^T)|` in rad, 0 to pi, for the first known orientation R_0.

    Args:
        quat_wxyz: Orientations R, (n, 4); NaN where unknown.
    """
    known = np.flatnonzero(np.isfinite(quat_wxyz).all(axis=1))
    if not len(known):
        return np.full(len(quat_wxyz), np.nan)
    w, x, y, z = quat_wxyz[known[0]]
    # Quaternion of R R_0^T: real part, then vector part.
    conjugate = np.array([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])
    parts = quat_wxyz @ conjugate.T
    angle: Array = 2.0 * np.arctan2(np.linalg.norm(parts[:, 1:], axis=1), np.abs(parts[:, 0]))
    return angle


def angle_apart(signals: Mapping[str, npt.NDArray[Any]], frame_wxyz: Array) -> Array:
    """`|log(R_s (C R_m C')')|` in rad at the arm's times, from its command and the hand's latest orientation.

    Args:
        signals: Signals of a pose run.
        frame_wxyz: Quaternion of C.
    """
    master_s, slave_s = signals["time_s"], signals.get("slave_time_s", signals["time_s"])
    last = np.clip(np.searchsorted(master_s, slave_s, side="right") - 1, 0, None)
    hand = signals["orientation"][last]
    command = signals["slave_command_orientation"]
    back = frame_wxyz * np.array([1.0, -1.0, -1.0, -1.0])
    target = _product(_product(np.broadcast_to(frame_wxyz, hand.shape), hand), np.broadcast_to(back, hand.shape))
    parts = _product(command, target * np.array([1.0, -1.0, -1.0, -1.0]))
    angle: Array = 2.0 * np.arctan2(np.linalg.norm(parts[:, 1:], axis=1), np.abs(parts[:, 0]))
    return angle


def _product(left: Array, right: Array) -> Array:
    """Products of quaternions w, x, y, z, row by row."""
    w, z, v, u = left[:, :1], right[:, :1], left[:, 1:], right[:, 1:]
    return np.concatenate([w * z - np.sum(v * u, axis=1, keepdims=True), w * u + z * v + np.cross(v, u)], axis=1)
