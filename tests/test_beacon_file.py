# SPDX-License-Identifier: Apache-2.0
"""Beacons of a table."""

from pathlib import Path

import pytest

from abyssnav.config import BeaconSetting
from abyssnav.errors import ConfigError
from abyssnav.read.beacon_file import beacons_from_file


def table(tmp_path: Path, text: str) -> tuple[BeaconSetting, ...]:
    path = tmp_path / "beacons.txt"
    path.write_text(text, encoding="utf-8")
    return beacons_from_file(path)


@pytest.mark.parametrize(
    "text",
    [
        "# name lat lon depth_m turnaround_ms\nT1 9.5 -154.25 4949.5 200\n"
        "T12 9.6 -154.5 5000 260\n",
        "id,name,latitude_deg,longitude_deg,depth,tat\n1,T1,9.5,-154.25,4949.5,0.2\n"
        "12,T12,9.6,-154.5,5000,0.26\n",
        "name;turn_around_s;depth_m;lon;lat\nT1;0.2;4949.5;-154.25;9.5\n\n# far\n"
        "T12;0.26;5000;-154.5;9.6",
    ],
)  # fmt: skip
def test_a_table_of_beacons_in_any_of_its_forms(text: str, tmp_path: Path) -> None:
    first, second = table(tmp_path, text)
    assert (first.id, first.name, first.turn_around_s, first.depth_m) == (1, "T1", 0.2, 4949.5)
    assert (second.id, second.latitude_deg, second.longitude_deg) == (12, 9.6, -154.5)
    assert second.turn_around_s == pytest.approx(0.26)


def test_a_table_of_local_places_with_sigma(tmp_path: Path) -> None:
    text = "id\teast_m\tnorth_m\tup_m\tturn_around_s\tsigma_m\n7\t1.5\t-2\t-300\t0.1\t0.4\n"
    (beacon,) = table(tmp_path, text)
    assert beacon.position_m == (1.5, -2.0, -300.0)
    assert (beacon.id, beacon.sigma_m, beacon.latitude_deg) == (7, 0.4, None)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "no line names the columns"),
        ("id lat lon depth tat\n", "no beacon below"),
        ("id lat lon depth\n1 2 3 4\n", "no column turn_around_s"),
        ("lat lon depth tat\n1 2 3 4\n", "no column id or name"),
        (
            "id lat lon tat\n1 2 3 4\n",
            "no columns latitude_deg, longitude_deg, depth_m, nor east_m",
        ),
        ("id lat lon depht tat\n1 2 3 4 5\n", "unknown column 'depht'; nearest: depth_m"),
        ("id lat lon depth_ms tat\n1 2 3 4 5\n", "depth_m is not in ms"),
        ("id lat lon depth tat\n1 2 3 4\n", "line 2: 4 values for 5 columns"),
        ("id lat lon depth tat\n1 2 x 4 5\n", "line 2: longitude_deg: 'x' is no number"),
        ("id lat lon depth tat\n1 95 3 4 5\n", "line 2: 95.0, 3.0 is no latitude"),
        ("name lat lon depth tat\nnorth 5 3 4 5\n", "'north' has not one number in it"),
        ("id lat lon depth tat\n1 5 3 4 5\n1 5 3 4 5\n", "beacon 1 is there 2 times"),
    ],
)
def test_a_table_that_cannot_be_is_refused_with_its_line(
    text: str, problem: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=problem):
        table(tmp_path, text)
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        beacons_from_file(tmp_path / "none.txt")
