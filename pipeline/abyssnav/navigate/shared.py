# SPDX-License-Identifier: Apache-2.0
"""What the methods of a dive share: each piece is made once, the long ones beside each other."""

from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from abyssnav.config import Config
from abyssnav.estimation.filter_problem import KnownStart, Problem
from abyssnav.estimation.leg_accuracy import beside_filter, leg_accuracy, without_compass
from abyssnav.estimation.smoother import SmootherResult
from abyssnav.estimation.tracker import Tracked, track
from abyssnav.navigate.augmented import (
    Tracking,
    pose_problem,
    real_time,
    real_time_places,
    thinned,
)
from abyssnav.navigate.baselines import (
    PAPER,
    confirmed_start,
    cycle_fixes,
    run_methods,
)
from abyssnav.navigate.inputs import MethodResult, NavigationInputs, settings_start
from abyssnav.navigate.smoothed import (
    arrivals,
    explains_most,
    final_track,
    guess_by_filter,
    guess_by_fixes,
    judged_times,
    leg_evidence,
    run_smoother,
    smoothed,
)
from abyssnav.tables import Fixes, Int, LegAccuracy, Start, Track


class _Smoothed(NamedTuple):
    """What the smoother says of a dive, all but where the bank began."""

    method: MethodResult
    arrivals: tuple[Int, Int]  #: class and explanation of every reply
    track: Track  #: every few seconds, by which the legs are judged
    legs: LegAccuracy


@dataclass(frozen=True)
class Shared:
    """One dive, and the executor that works beside this process."""

    inputs: NavigationInputs
    config: Config
    executor: Executor

    def begin(self, wanted: tuple[str, ...]) -> None:
        """Give the executor the banks, which take longest, and make all else meanwhile."""
        if "ekf_huber" in wanted:
            _ = self._huber
        if {"ekf", "smoother"} & set(wanted):
            _ = self._bank
        if "smoother" in wanted:
            _ = self._smoothed
        if any(method in wanted for method in PAPER):
            _ = self._paper

    @cached_property
    def fixes(self) -> Fixes:
        """The fix of every cycle that has one."""
        return cycle_fixes(self.inputs, self.config)

    @cached_property
    def confirmed(self) -> Start | None:
        """The start that the consistent fixes confirm."""
        return confirmed_start(self.fixes, self.config)

    @cached_property
    def known(self) -> KnownStart | None:
        """The start that `ekf` and `smoother` are given: by the settings, or as those ask for."""
        known, rule = settings_start(self.inputs, self.config), self.config.start
        if known is None and rule.ekf == "m_of_n" and self.confirmed is not None:
            return KnownStart(self.confirmed, rule.sigma_m)
        return known

    @cached_property
    def _bank(self) -> tuple[Problem, Future[Tracked]]:
        return self._submit_filter(huber=False)

    @cached_property
    def _huber(self) -> tuple[Problem, Future[Tracked]]:
        return self._submit_filter(huber=True)

    def _submit_filter(self, *, huber: bool) -> tuple[Problem, Future[Tracked]]:
        problem = pose_problem(self.inputs, self.config, huber=huber)
        return problem, self.executor.submit(track, thinned(problem, self.known), self.known)

    @cached_property
    def _paper(self) -> dict[str, MethodResult]:
        return run_methods(self.inputs, self.fixes, self.confirmed, self.config)

    @cached_property
    def tracking(self) -> Tracking:
        """The bank's run."""
        problem, job = self._bank
        return Tracking(problem, job.result())

    def smooth(self) -> SmootherResult | None:
        """From the fixes, which need not wait for the bank; from its track where they will not do.

        Both lead to the same estimate wherever either leads to a good one.
        """
        inputs, config = self.inputs, self.config
        guess = guess_by_fixes(inputs, self.fixes)
        if guess is not None:
            result = run_smoother(inputs, self.known, guess, self.fixes, config)
            if result is not None and explains_most(result):
                return result
        guess = guess_by_filter(inputs.dive, self.tracking)
        return run_smoother(inputs, self.known, guess, self.fixes, config)

    @cached_property
    def _smoothed(self) -> _Smoothed | None:
        inputs, result, config = self.inputs, self.smooth(), self.config
        if result is None:
            return None
        track = final_track(inputs, result, judged_times(inputs))
        legs = leg_accuracy(leg_evidence(inputs, result, self.fixes, config), track)
        legs = without_compass(legs, inputs.dive.heading, inputs.dive.velocity)
        final = smoothed(inputs, result, config)
        return _Smoothed(final, arrivals(inputs, result, config), track, legs)

    @cached_property
    def final(self) -> _Smoothed | None:
        """What the smoother hands out: nothing where the side of a line of beacons stays open."""
        open_side = self.tracking.start is None and bool(self.tracking.tracked.sides)
        return None if open_side else self._smoothed

    def of_paper(self, name: str) -> MethodResult | None:
        """One of the paper's methods; None without a confirmed start where it needs one."""
        return self._paper.get(name)

    def ekf(self) -> MethodResult:
        """The bank's track as known at each instant."""
        return real_time(self.inputs, self.tracking, "ekf")

    def ekf_huber(self) -> MethodResult:
        """One filter that weighs residuals in place of a tight gate."""
        problem, job = self._huber
        return real_time(self.inputs, Tracking(problem, job.result()), "ekf_huber")

    def smoother(self) -> MethodResult:
        """The final track; without one, what the bank made of the replies."""
        if self.final is None:
            return self.ekf()._replace(track=None, events=(), positions=None)
        return self.final.method._replace(start=self.tracking.start)

    def legs(self) -> LegAccuracy | None:
        """How good the final track is, leg by leg."""
        if self.final is None:
            return None
        if self.tracking.start is None:
            return self.final.legs
        track = self.final.track
        live = real_time_places(self.inputs, self.tracking, track.t_s)
        return beside_filter(self.final.legs, track, live)

    def arrivals(self) -> tuple[Int, Int] | None:
        """Class and explanation of every reply."""
        return None if self.final is None else self.final.arrivals
