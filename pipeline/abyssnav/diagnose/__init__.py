# SPDX-License-Identifier: Apache-2.0
"""Stage diagnose: can the tracks be relied on, and if not, what is the likeliest cause."""

from abyssnav.diagnose.conventions import conventions, with_conventions
from abyssnav.diagnose.verdict import with_verdict

__all__ = ["conventions", "with_conventions", "with_verdict"]
