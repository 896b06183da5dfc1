# SPDX-License-Identifier: Apache-2.0
"""Stage read: MCAP files and a profile to a `Log`, as recorded; what a file holds."""

from abyssnav.read.inspect import Inspection, TopicSummary, inspect
from abyssnav.read.log import read, read_optional

__all__ = ["Inspection", "TopicSummary", "inspect", "read", "read_optional"]
