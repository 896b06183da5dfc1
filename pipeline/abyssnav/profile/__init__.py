# SPDX-License-Identifier: Apache-2.0
"""A profile: which topic and fields of a vehicle's log are which of our columns.

Our name stands left, the log's right; one table a role, one TOML file a vehicle.  A field is a
dotted path, `[k]` picks from an array.  The conversion follows from unit, scale and offset, so a
profile holds no code.
"""

from abyssnav.profile.load import (
    load_profile,
    profile_from_toml,
    profile_names,
    same_type,
    shipped_profiles,
)
from abyssnav.profile.model import (
    REQUIRED,
    ROLES,
    SENSORS,
    UNITS,
    AltitudeRole,
    BeaconsRole,
    Condition,
    DepthRole,
    HeadingRole,
    PositionRole,
    Profile,
    Quantity,
    ReferenceRole,
    Role,
    SoundSpeedRole,
    TimeField,
    Topics,
    TravelTimeRole,
    Triple,
    Value,
    VelocityRole,
    conditions,
    paths_of,
    quantities,
    slots,
)

__all__ = [
    "REQUIRED", "ROLES", "SENSORS", "UNITS", "AltitudeRole", "BeaconsRole", "Condition",
    "DepthRole", "HeadingRole", "PositionRole", "Profile", "Quantity", "ReferenceRole", "Role",
    "SoundSpeedRole", "TimeField", "Topics", "TravelTimeRole", "Triple", "Value", "VelocityRole",
    "conditions", "load_profile", "paths_of", "profile_from_toml", "profile_names", "quantities",
    "same_type", "shipped_profiles", "slots",
]  # fmt: skip
