# SPDX-License-Identifier: Apache-2.0
"""Stage read: MCAP files and a profile to a `Log`, as recorded; what a file holds."""

from pipeline.read.log import read
from pipeline.read.survey import Survey, TopicSummary, survey

__all__ = ["Survey", "TopicSummary", "read", "survey"]
