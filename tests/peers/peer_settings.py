# SPDX-License-Identifier: Apache-2.0
"""Numbers that every peer's model takes, and where each comes from.

They are what a careful engineer knows before the dive, by data sheets and the log's own words.
They are not abyssnav's defaults: offset and scale are wider here (3 and 2 degrees, 1 and 0.4 %),
and its two-state filters let the position walk eight times as much.  None was tuned on a dive.
"""

from math import radians

#: The compass' constant offset: 3 degrees is what a TCM keeps after calibration in a hull.
HEADING_SIGMA_RAD = radians(3.0)
#: It wanders by half a degree within ten minutes.
HEADING_WALK_RAD2_PER_S = radians(0.5) ** 2 / 600.0
#: The DVL's scale: 1 %, which covers 0.4 % of its data sheet and the sound speed at its face.
DVL_SCALE_SIGMA = 0.01
#: Slow errors of 5 mm/s along and 0.3 degrees x 1.2 m/s across, alike for 5 min: q = 2 σ² τ.
POSITION_WALK_M2_PER_S = 2 * (0.005**2 + 0.006**2) * 300.0
#: Of the rows "loose motion": what abyssnav gives its own two-state filters, against lock-out.
LOOSE_WALK_M2_PER_S = 0.3
#: Two-way: 3 sigma of the time, and 1 % of the slant range.
RANGE_GATE_SHARE = 0.01
