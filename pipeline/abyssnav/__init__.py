# SPDX-License-Identifier: Apache-2.0
"""abyssnav: an AUV's raw dive log in, a track people trust out.

    log -> dive -> solution -> outputs

`read` takes MCAP files to a `Log` (as recorded), `align` to a `Dive` (one clock, checked),
`navigate` to a `Solution` (tracks, fixes, innovations); `compare`, `write` and `view` hand it on.

Glossary
--------
ENU
    Local frame: x east, y north, z up, metres from the dive's origin.  `depth_m` is positive down.
body
    Forward, starboard, down.  A heading is clockwise from true north, in radians.
time
    `_ns` int64 nanoseconds UTC at rest; `_s` float64 seconds since the dive's start in between.
ping, reply, cycle
    One interrogation; one beacon's answer to it; the replies that one fix uses.
travel time
    Two-way: reply heard minus ping, the beacon's turn-around included.

The equations are those of "Deep Sea AUV Navigation Using Multiple Acoustic Beacons"; docstrings
name them as Eq. 1 to Eq. 11.
"""

__version__ = "0.2.0"
