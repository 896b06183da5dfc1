# SPDX-License-Identifier: Apache-2.0
import itertools

import numpy as np
import pytest

from abyssnav.outputs.palette import ACCEPTED, GROUND, METHOD_COLOURS, REJECTED, beacon_colour, rgb
from abyssnav.tables import METHODS

#: Machado, Oliveira and Fernandes (2009), severity 1.0, on linear RGB.
VISION = {
    "full": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def linear(colour):
    share = np.array(colour) / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def lab(light):
    relative = TO_XYZ @ np.clip(light, 0, 1) / (0.9505, 1.0, 1.089)
    f = np.where(relative > 0.008856, np.cbrt(relative), 7.787 * relative + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def contrast(one, other):
    low, high = sorted(linear(c) @ TO_XYZ[1] for c in (one, other))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize(
    ("vision", "least"),
    [("full", 38), ("protanopia", 28), ("deuteranopia", 27), ("tritanopia", 22)],
)
def test_every_eye_tells_any_two_methods_apart(vision, least):
    seen = [lab(np.array(VISION[vision]) @ linear(rgb(c))) for c in METHOD_COLOURS.values()]
    apart = [np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)]
    assert min(apart) >= least


@pytest.mark.parametrize("vision", VISION)
def test_every_eye_tells_accepted_from_rejected(vision):
    seen = [lab(np.array(VISION[vision]) @ linear(rgb(c))) for c in (ACCEPTED, REJECTED)]
    assert np.linalg.norm(seen[0] - seen[1]) > 60


@pytest.mark.parametrize("method", METHODS)
def test_each_method_has_a_colour_that_stands_out_from_paper_and_from_the_viewer(method):
    colour = rgb(METHOD_COLOURS[method])
    assert contrast(colour, (255, 255, 255)) > 2.4
    assert contrast(colour, GROUND) > 3.0


def test_the_first_six_beacons_of_a_plot_differ():
    assert len({beacon_colour(k) for k in range(6)}) == 6
