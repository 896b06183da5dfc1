# SPDX-License-Identifier: Apache-2.0
"""Stage diagnose: can the tracks be relied on, and if not, what is the likeliest cause."""

from abyssnav.diagnose.verdict import with_verdict

__all__ = ["with_verdict"]
