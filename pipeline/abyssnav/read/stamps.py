# SPDX-License-Identifier: Apache-2.0
"""Stamps beside log time: unset, since boot, running back, repeated, late, drifting, jumping."""

import msgspec
import numpy as np

from abyssnav.profile import SENSORS, Role
from abyssnav.read.fields import RoleFields
from abyssnav.tables import Finding, Float, Int

#: A stamp before 1990 was never set, or counts from something else.
_UNSET_NS = 631_152_000_000_000_000
#: Stamps farther from log time than a day are of another clock.
OTHER_CLOCK_NS = 86_400_000_000_000
#: Log time follows the stamp by transport, not by more.
_MAX_LATE_S = 1.0
#: A clock that gains or loses less than this in the dive, or jumps by less, harms nothing; and by
#: so many times what the delays scatter it stands out.
_LEAST_DRIFT_S, _LEAST_JUMP_S, _SCATTERS = 0.2, 0.5, 8.0
#: Delays are averaged in so many blocks; of fewer messages nothing is said.
_BLOCKS, _LEAST_MESSAGES = 24, 48


def is_of_other_clock(fields: RoleFields) -> bool:
    """Whether most stamps are more than a day from the log's time: since boot, or never set."""
    log_time_ns = fields.log_time_ns[fields.message]
    away_ns = np.abs(log_time_ns - fields.time_ns())
    return bool(
        len(away_ns) and np.median(away_ns) > OTHER_CLOCK_NS and np.median(log_time_ns) > _UNSET_NS
    )


def on_recorders_clock(fields: RoleFields) -> Role:
    """The role with the recorder's times; pings of the same clock follow from their replies."""
    role = msgspec.structs.replace(fields.role, time="log_time")
    return msgspec.structs.replace(role, ping_time="") if _pings_too(fields) else role


def _pings_too(fields: RoleFields) -> bool:
    """Whether the pings have stamps of their own, by the clock of the replies."""
    ping = getattr(fields.role, "ping_time", "")
    if not ping or not len(fields.message):
        return False
    away_ns = np.abs(fields.stamps(ping) - fields.stamps(fields.role.time))
    return bool(np.median(away_ns) < OTHER_CLOCK_NS)


def clock_findings(role: str, fields: RoleFields) -> list[Finding]:
    """Stamps that were never set, run back, or do not keep pace with the log's own time."""
    stamp_ns, log_ns = fields.time_ns(), fields.log_time_ns[fields.message]
    topic, unset = fields.role.where, stamp_ns < _UNSET_NS
    findings = []
    line = 'time = "log_time"' + (' with ping_time = ""' if _pings_too(fields) else "")
    mend = f"; {line} takes the recorder's" if is_of_other_clock(fields) else ""
    if unset.any():
        detail = f"{int(unset.sum())} of {len(stamp_ns)} messages have no stamp (before 1990)"
        detail += _offset(stamp_ns[unset], log_ns[unset]) if mend else ""
        findings.append(Finding("clock: unset stamps", topic, detail + mend))
    stamp_ns, log_ns = stamp_ns[~unset], log_ns[~unset]
    back = int((np.diff(stamp_ns) < 0).sum())
    if back:
        detail = f"{back} times, in order of log time"
        findings.append(Finding("clock: stamps run back", topic, detail))
    repeats = len(stamp_ns) - len(np.unique(stamp_ns))
    if repeats and role in SENSORS:  # replies and positions may come together
        detail = f"{repeats} messages have the stamp of another; the first one counts"
        findings.append(Finding("clock: stamps repeat", topic, detail))
    late_s = (log_ns - stamp_ns) / 1e9
    middle_s = float(np.median(late_s)) if len(late_s) else 0.0
    if abs(middle_s) > _MAX_LATE_S:
        detail = f"log time is {middle_s:+.3f} s after the {role} stamps, in the median{mend}"
        findings.append(Finding("clock: stamp and log differ", topic, detail))
    return findings + _pace(role, topic, log_ns, late_s)


def _offset(stamp_ns: Int, log_ns: Int) -> str:
    """The offset to the log's time where stamps run, but from another beginning."""
    if len(np.unique(stamp_ns)) < 0.5 * len(stamp_ns):
        return ""  # never set at all
    late_s = (log_ns - stamp_ns) / 1e9
    middle_s = float(np.median(late_s))
    scatter_s = 1.4826 * float(np.median(np.abs(late_s - middle_s)))
    return (
        f"; they count from another beginning, {middle_s:.3f} s before log time's "
        f"(give or take {scatter_s:.3f} s)"
    )


def _pace(role: str, topic: str, log_ns: Int, late_s: Float) -> list[Finding]:
    """A drift or one jump of the stamps against log time, by the median delay of each block."""
    if len(late_s) < _LEAST_MESSAGES:
        return []
    blocks = np.array_split(np.arange(len(late_s)), _BLOCKS)
    median_s = np.array([np.median(late_s[block]) for block in blocks])
    hours = np.array([np.median(log_ns[block]) - log_ns[0] for block in blocks]) / 3.6e12
    scatter_s = 1.4826 * float(np.median(np.abs(late_s - np.repeat(median_s, [*map(len, blocks)]))))
    step_s = np.diff(median_s)
    largest = int(np.argmax(np.abs(step_s)))
    others_s = float(np.median(np.abs(np.delete(step_s, largest))))
    jump_s = -float(step_s[largest])
    if abs(jump_s) > max(_LEAST_JUMP_S, _SCATTERS * (scatter_s + others_s)):
        detail = (
            f"the {role} stamps jump by {jump_s:+.2f} s against log time, {hours[largest]:.2f} h "
            "after the first: a clock was set during the dive"
        )
        return [Finding("clock: jump", topic, f"{detail}{_EITHER}")]
    away_h = hours - hours.mean()
    slope = float(away_h @ median_s / max(away_h @ away_h, 1e-12))  # s an hour
    gained_s = slope * float(np.ptp(hours))
    left_s = float(np.std(median_s - slope * away_h))
    if abs(gained_s) > max(_LEAST_DRIFT_S, _SCATTERS * left_s):
        detail = (
            f"the {role} stamps {'lose' if slope > 0 else 'gain'} {abs(slope):.3f} s an hour "
            f"against log time, {abs(gained_s):.2f} s in all: one of the two clocks drifts"
        )
        return [Finding("clock: drift", topic, f"{detail}{_EITHER}")]
    return []


_EITHER = '; where the recorder\'s clock is the better one, time = "log_time" takes it'
