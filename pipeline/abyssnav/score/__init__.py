# SPDX-License-Identifier: Apache-2.0
"""Anybody's track against a log's reference: one, or a folder of them against a benchmark's."""

from abyssnav.score.folders import DiveScore, PooledScore, pool, score_folder
from abyssnav.score.given_track import GivenTrack, load_track
from abyssnav.score.measures import Options, TrackScore, score

__all__ = [
    "DiveScore",
    "GivenTrack",
    "Options",
    "PooledScore",
    "TrackScore",
    "load_track",
    "pool",
    "score",
    "score_folder",
]
