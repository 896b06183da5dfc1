# SPDX-License-Identifier: Apache-2.0
"""The whole of the navigation on one screen."""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import ray_check
from abyssnav.config import Config
from abyssnav.errors import ConfigError
from abyssnav.estimation.gate_integrity import GatedFilter, assess_gate, gate_statistics
from abyssnav.estimation.two_state import ACCEPTED
from abyssnav.navigate.augmented import side_checks
from abyssnav.navigate.baselines import PAPER
from abyssnav.navigate.inputs import MethodResult, NavigationInputs, first_velocity_s, prepare
from abyssnav.navigate.shared import Shared
from abyssnav.second_process import InlineExecutor
from abyssnav.tables import (
    METHODS,
    OPTIONAL_METHODS,
    VERDICTS,
    Check,
    Dive,
    Fixes,
    GateIntegrity,
    LegAccuracy,
    Solution,
    Start,
)


class Method(NamedTuple):
    """One way to a track."""

    name: str
    run: Callable[[Shared], MethodResult | None]


def _of_paper(name: str) -> Method:
    return Method(name, lambda shared: shared.of_paper(name))


#: In the order in which people read them.
_METHODS: Final = (
    *(_of_paper(name) for name in PAPER),
    Method("ekf", Shared.ekf),
    Method("smoother", Shared.smoother),
    Method("ekf_huber", Shared.ekf_huber),
)


def navigate(dive: Dive, config: Config, executor: Executor | None = None) -> Solution:
    """Tracks, fixes and innovations of one dive by every method asked for.

    Methods do not hear of each other: leaving one out, or another output rate, moves no estimate.
    Without a confirmed start there are dead reckoning (from the first fix, or the frame's origin),
    the fixes, innovations that all say `before_start`, and a check that says so.

    Parameters
    ----------
    executor : for the banks of filters, beside all else; by default this process

    Raises
    ------
    ConfigError
        An unknown name in `output.methods`.
    """
    wanted = _methods(config)
    shared = Shared(prepare(dive, config), config, executor or InlineExecutor())
    shared.begin(wanted)
    smooths = "smoother" in wanted
    legs, classes = (shared.legs(), shared.arrivals()) if smooths else (None, None)
    made = {m.name: m.run(shared) for m in _METHODS if m.name in wanted}
    results = {name: one for name in wanted if (one := made.get(name)) is not None}
    if classes is not None:
        results = _classified(results, *classes)
    sides = side_checks(shared.tracking) if {"ekf", "smoother"} & set(wanted) else ()
    solution = _solution(shared, results, legs)
    return replace(solution, checks=solution.checks + sides)


def _solution(
    shared: Shared, results: dict[str, MethodResult], accuracy: LegAccuracy | None
) -> Solution:
    """Gather what the methods made, and how their gates did."""
    inputs, config = shared.inputs, shared.config
    dive, speed_mps = inputs.dive, inputs.geometry.mean_speed_mps
    gated = {
        m: GatedFilter(r.innovations, r.track, r.gamma, r.noise_s)
        for m, r in results.items()
        if r.innovations is not None
    }
    final = results["smoother"].track if "smoother" in results else None
    ids, stretch_s = np.sort(dive.beacons.id), config.gate.stretch_s
    watch = {m: assess_gate(g, final, ids, speed_mps, stretch_s) for m, g in gated.items()}
    return Solution(
        dive=dive,
        tracks={m: r.track for m, r in results.items() if r.track is not None},
        fixes=shared.fixes,
        innovations={m: g.innovations for m, g in gated.items()},
        statistics={
            m: gate_statistics(g.innovations, dive.beacons.id, g.gamma, speed_mps, watch[m])
            for m, g in gated.items()
        },
        starts={m: r.start for m, r in results.items() if r.start is not None},
        gamma=config.gate.threshold,
        estimates={
            m: result.estimates for m, result in results.items() if result.estimates is not None
        },
        positions={
            m: result.positions for m, result in results.items() if result.positions is not None
        },
        watch=watch,
        accuracy=accuracy,
        learned=results["smoother"].learned if "smoother" in results else (),
        beacons=results["smoother"].beacons if "smoother" in results else None,
        causes=results["smoother"].causes if "smoother" in results else (),
        events=tuple(event for result in results.values() for event in result.events),
        checks=_checks(shared.confirmed, shared.fixes, dive)
        + _agreement_checks(results, config.start.ekf)
        + _ray_checks(inputs, results, config.acoustics.travel_time_sigma_s)
        + _noise_checks(results, config.acoustics.travel_time_sigma_s)
        + tuple(check for m, table in watch.items() for check in _watch_checks(m, table)),
    )


def _methods(config: Config) -> tuple[str, ...]:
    """The methods asked for, in the order in which people read them."""
    asked, known = config.output.methods, (*METHODS, *OPTIONAL_METHODS)
    for name in asked:
        if name not in (*known, "all"):
            names = ", ".join(("all", *known))
            raise ConfigError(f"[output] methods: unknown {name!r}; known: {names}")
    return tuple(m for m in known if m in asked or ("all" in asked and m in METHODS))


def _classified(
    results: dict[str, MethodResult], arrival: np.ndarray, why: np.ndarray
) -> dict[str, MethodResult]:
    """The same results, their innovations completed by how each reply came."""
    return {
        method: r
        if r.innovations is None
        else r._replace(innovations=replace(r.innovations, arrival=arrival, explanation=why))
        for method, r in results.items()
    }


def _checks(start: Start | None, fixes: Fixes, dive: Dive) -> tuple[Check, ...]:
    n_fixes, n_consistent = len(fixes), int(fixes.consistent.sum())
    early = int(np.sum(dive.replies.t_reply_s < first_velocity_s(dive)))
    back = "dead reckoning goes back from the first velocity, where tracks begin" if early else ""
    is_found = start is not None
    detail = (
        "" if is_found else "no start confirmed by M of N: no kf_fix, ekf_ungated and ekf_gated"
    )
    return (
        Check("navigate", "start_confirmed", float(is_found), 1, "", is_found, detail, "min"),
        Check("navigate", "fixes", n_fixes, 1, "", n_fixes > 0, bound="min"),
        Check("navigate", "consistent_fixes", n_consistent, 1, "", n_consistent > 0, bound="min"),
        Check("navigate", "replies_before_first_velocity", early, 0, "", early == 0, back),
    )


def _agreement_checks(results: dict[str, MethodResult], asked: str) -> tuple[Check, ...]:
    """Whether the product's own methods found a start, and found it as they were asked to."""
    starts = [results[m].start for m in ("ekf", "smoother") if m in results]
    if not starts:
        return ()
    start = starts[0]
    is_found = start is not None
    detail = "" if is_found else "too few travel times agree on a place: no ekf, no smoother"
    check = Check("navigate", "travel_times_agree", float(is_found), 1, "", is_found, detail, "min")
    if start is None or asked == "consensus":
        return (check,)
    as_asked = start.how == asked
    detail = "" if as_asked else "M of N confirmed no start; ekf and smoother begin by consensus"
    return check, Check(
        "navigate", "ekf_starts_as_asked", float(as_asked), 1, "", as_asked, detail, "min"
    )


def _ray_checks(
    inputs: NavigationInputs, results: dict[str, MethodResult], sigma_s: float
) -> tuple[Check, ...]:
    """How far bent rays matter for the replies that the best method believed."""
    believed = next(
        (
            result.innovations.decision[inputs.usable] == ACCEPTED
            for method in ("smoother", "ekf", "ekf_gated")
            if (result := results.get(method)) is not None and result.innovations is not None
        ),
        np.ones(len(inputs.usable_replies), dtype=bool),
    )
    dive, n = inputs.dive, max(int(believed.sum()), 1)
    rays = ray_check(
        inputs.geometry[believed],
        inputs.usable_replies[believed],
        dive.sound_speed,
        sigma_s=sigma_s,
    )
    saved = f"a straight ray would be up to {1e3 * rays.largest_s:.2f} ms too long"
    detail = saved if rays.n_traced else "straight rays are good to a tenth of sigma"
    lost = "no direct ray leads to the beacon; the straight one is used" if rays.n_shadow else ""
    return (
        Check("navigate", "replies_by_bent_rays", rays.n_traced / n, 1.0, "", True, detail),
        Check("navigate", "replies_in_shadow", rays.n_shadow, 0, "", rays.n_shadow == 0, lost),
    )


def _noise_checks(results: dict[str, MethodResult], sigma_s: float) -> tuple[Check, ...]:
    """How much noisier than stated the smoother found the noisiest beacon's times."""
    result = results.get("smoother")
    if result is None or result.innovations is None or not np.isfinite(result.noise_s).any():
        return ()
    noise_s = np.broadcast_to(result.noise_s, len(result.innovations))
    row = int(np.nanargmax(noise_s))
    largest_s, beacon_id = float(noise_s[row]), result.innovations.beacon_id[row]
    ratio = largest_s / sigma_s
    detail = (
        f"beacon {beacon_id}: {1e3 * largest_s:.1f} ms, not {1e3 * sigma_s:.1f} ms; "
        "learned, but acoustics.travel_time_sigma_s should say so"
    )
    ok = ratio <= 1.5
    return (Check("navigate", "noise_over_stated", ratio, 1.5, "", ok, "" if ok else detail),)


def _watch_checks(method: str, watch: GateIntegrity) -> tuple[Check, ...]:
    """Stretches in which a gate was inert, starving or captured, for the methods that have one."""
    if method == "ekf_ungated":
        return ()
    n_cells = max(len(watch), 1)
    counts = np.bincount(watch.verdict, minlength=len(VERDICTS))
    return tuple(
        Check(
            "navigate",
            f"{method}_gate_{name}",
            float(counts[code] / n_cells),
            0.05,
            "",
            bool(counts[code] <= 0.05 * n_cells),
            _where(watch, code),
        )
        for code, name in enumerate(VERDICTS)
        if name in ("inert", "starving", "captured")
    )


def _where(watch: GateIntegrity, code: int) -> str:
    first = np.flatnonzero(watch.verdict == code)[:1]
    if not len(first):
        return ""
    row = int(first[0])
    return (
        f"share of stretches; first: beacon {watch.beacon_id[row]} at {watch.t_begin_s[row]:.0f} s"
    )
