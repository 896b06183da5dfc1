# SPDX-License-Identifier: Apache-2.0
"""Forward, port, up or forward, starboard, down: by the depth, else by what a definition says."""

import re
from collections.abc import Mapping
from typing import Literal

import numpy as np

from abyssnav.read.samples import TopicSample
from abyssnav.tables import Columns, Float

BodyFrame = Literal["flu", "frd"]
#: Stretches over which depth and vertical speed are compared; noise of the depth averages out.
_SHORTEST_S, _LONGEST_S, _STRETCHES = 5.0, 60.0, 40
#: Log-likelihood ratio from which on the depth decides, and from which on it overrules what a
#: definition says; large, as attitude that is not logged makes either sign look better by chance.
_DECIDES, _OVERRULES = 5.0, 10.0


def frame_by_depth(
    roles: Mapping[str, Columns], frame: BodyFrame, is_stated: bool
) -> tuple[BodyFrame | None, str]:
    """The frame with which the vertical velocity explains how depth changes; None if neither does.

    Over stretches of up to a minute, with w the third component in `frd` and minus it in `flu`:

        Δdepth = ∫ (w cos θ - u sin θ) dt

    Roll is left out.  The likelihood ratio of the two signs is (n / 2) ln of their mean squares'.

    Parameters
    ----------
    roles : columns of velocity, depth and heading, all messages, as read with `frame`
    is_stated : whether a definition or a standard says `frame`
    """
    moving, deep, turning = roles["velocity"], roles["depth"], roles["heading"]
    if "velocity_body_mps" not in moving:
        return None, ""
    scale = 1.0 if "depth_m" in deep else 0.99  # a dbar is nearly a metre
    depth_m = scale * deep["depth_m" if "depth_m" in deep else "pressure_dbar"]
    start_ns = deep["time_ns"].min()
    t_depth_s, depth_m = _sorted(deep["time_ns"], depth_m, start_ns)
    good = moving["valid"]
    t_s, body_mps = _sorted(moving["time_ns"][good], moving["velocity_body_mps"][good], start_ns)
    if len(t_s) < _STRETCHES or len(t_depth_s) < _STRETCHES:
        return None, ""
    t_attitude_s, pitch_rad = _sorted(turning["time_ns"], turning["pitch_rad"], start_ns)
    pitch_rad = np.interp(t_s, t_attitude_s, np.nan_to_num(pitch_rad))
    begin_s = max(t_s[0], t_depth_s[0])
    end_s = min(t_s[-1], t_depth_s[-1])
    length_s = float(np.clip((end_s - begin_s) / _STRETCHES, _SHORTEST_S, _LONGEST_S))
    edges_s = np.arange(begin_s, end_s, length_s)
    if len(edges_s) < 8:
        return None, ""
    deeper_m = np.diff(np.interp(edges_s, t_depth_s, depth_m))
    ahead_m = _integral(t_s, -body_mps[:, 0] * np.sin(pitch_rad), edges_s)
    below_m = _integral(t_s, body_mps[:, 2] * np.cos(pitch_rad), edges_s)
    as_is_m2 = _mean_square(deeper_m - ahead_m - below_m)
    turned_m2 = _mean_square(deeper_m - ahead_m + below_m)
    ratio = 0.5 * len(deeper_m) * float(np.log(turned_m2 / as_is_m2))
    if abs(ratio) < _DECIDES or (is_stated and -_OVERRULES < ratio < 0):
        return None, "depth changes too little to tell"
    other: BodyFrame = "frd" if frame == "flu" else "flu"
    chosen = frame if ratio > 0 else other
    sense = "as" if chosen == "frd" else "against"
    return chosen, f"depth changes {sense} its third component (log-likelihood {abs(ratio):.0f})"


def _sorted(time_ns: np.ndarray, values: Float, start_ns: int) -> tuple[Float, Float]:
    order = np.argsort(time_ns, kind="stable")
    return (time_ns[order] - start_ns) / 1e9, values[order]


def _integral(t_s: Float, rate: Float, edges_s: Float) -> Float:
    """Integral of a rate between each edge and the next, by the trapezoidal rule."""
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(t_s)
    return np.diff(np.interp(edges_s, t_s, np.concatenate([[0.0], np.cumsum(steps)])))


def _mean_square(values: Float) -> float:
    """Mean square without the tenth that is largest: gaps of the DVL are in it."""
    squares = np.sort(values**2)
    return float(np.mean(squares[: max(1, int(0.9 * len(squares)))])) + 1e-12


def frame_by_definition(sample: TopicSample, path: str) -> tuple[BodyFrame | None, str]:
    """The frame that the comment beside a field in its message's definition speaks of."""
    if re.search(r"vision_?position_?delta", sample.channel.type, re.IGNORECASE):
        return "frd", "as MAVLink has it"
    name = re.sub(r"\[\d+\]", "", path).split(".")[-1]
    text = sample.channel.definition.decode("utf-8", "replace")
    for line in text.splitlines():
        field, _, comment = line.partition("#")
        if re.search(rf"\b{re.escape(name)}\b", field) and comment:
            if re.search(r"\b(star|stbd|right|frd)", comment, re.IGNORECASE):
                return "frd", f"its definition says {comment.strip()[:60]!r}"
            if re.search(r"\b(port|left|flu)\b", comment, re.IGNORECASE):
                return "flu", f"its definition says {comment.strip()[:60]!r}"
    return None, ""
