# SPDX-License-Identifier: Apache-2.0
"""One colour for one thing, in the recording, the report and every figure.

The methods' colours were searched for the largest least CIELAB distance between any two of them,
as seen with full colour vision, protanopia, deuteranopia (28 in each) and tritanopia, at a
luminance that stands out from white paper and from the viewer's near-black alike.
"""

from typing import Final

#: Method -> sRGB.
METHOD_COLOURS: Final = {
    "dead_reckoning": "#767676",
    "fix": "#b41f9f",
    "kf_fix": "#c5940d",
    "ekf_ungated": "#bb3225",
    "ekf_gated": "#0860fd",
    "ekf": "#4db670",
    "smoother": "#ac92ff",
}
#: The same in words.
COLOUR_NAMES: Final = {
    "dead_reckoning": "grey",
    "fix": "magenta",
    "kf_fix": "ochre",
    "ekf_ungated": "red",
    "ekf_gated": "blue",
    "ekf": "green",
    "smoother": "violet",
}
#: A method that is not in the contract.
OTHER_METHOD: Final = "#a8896c"

BEACON: Final = "#e8b500"
INCONSISTENT_FIX: Final = "#8f6f8a"
#: Fixes of another kind, GNSS or USBL, and those that were not accepted.
POSITION: Final = "#00a5c4"
REFUSED_POSITION: Final = "#5f838b"
REFERENCE: Final = "#9aa4ad"
DEPTH: Final = "#3c9fb0"

#: The pair of the innovation plots: blue and orange are the pair every eye tells apart.
ACCEPTED: Final = "#2f8fe0"
REJECTED: Final = "#e07b00"
#: The same pair for ranges, dim enough to lie under the tracks.
ACCEPTED_RANGE: Final = "#1b4a70"
REJECTED_RANGE: Final = "#7a4a14"
BOUND: Final = "#8a949c"

#: Ends of a track, and the scale of a plan.
START: Final = "#2fae66"
END: Final = "#e05252"
SCALE: Final = "#d5dde3"

#: Behind the recording's plan, and its grid.
GROUND: Final = (13, 17, 23)
GRID: Final = (120, 140, 155, 60)


def method_colour(method: str) -> str:
    """Colour of `method`, as `#rrggbb`."""
    return METHOD_COLOURS.get(method, OTHER_METHOD)


def colour_name(method: str) -> str:
    """Colour of `method` in a word."""
    return COLOUR_NAMES.get(method, "brown")


def beacon_colour(place: int) -> str:
    """Colour of the beacon at `place` in the dive's list, where beacons share a plot."""
    colours = [c for method, c in METHOD_COLOURS.items() if method != "dead_reckoning"]
    return colours[place % len(colours)]


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue, 0-255, of a colour written `#rrggbb`."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


#: From little to much, lightness falling all the way: as viridis, told apart by every eye.
SEQUENTIAL: Final = ("#fde725", "#7ad151", "#22a884", "#2a788e", "#414487", "#440154")


def sequential(share: float) -> str:
    """Colour of a share from 0, light, to 1, dark, as `#rrggbb`."""
    place = min(max(share, 0.0), 1.0) * (len(SEQUENTIAL) - 1)
    first = min(int(place), len(SEQUENTIAL) - 2)
    low, high = rgb(SEQUENTIAL[first]), rgb(SEQUENTIAL[first + 1])
    mixed = [round(a + (place - first) * (b - a)) for a, b in zip(low, high, strict=True)]
    return "#{:02x}{:02x}{:02x}".format(*mixed)


#: Level of a verdict -> colour under white letters.
LEVEL_COLOURS: Final = {"good": "#1a7f45", "check": "#a85f00", "unusable": "#c22a2a"}


def level_colour(level: str) -> str:
    """Colour of a verdict's level, dark enough for white letters on it."""
    return LEVEL_COLOURS.get(level, "#5b6b78")
