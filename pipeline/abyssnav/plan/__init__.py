# SPDX-License-Identifier: Apache-2.0
"""Planning: how well a beacon layout lets a vehicle navigate, before the dive."""

from abyssnav.plan.expect import Change, Plan, expect
from abyssnav.plan.layout import Layout, load_layout
from abyssnav.plan.write import write_plan

__all__ = ["Change", "Layout", "Plan", "expect", "load_layout", "write_plan"]
