# SPDX-License-Identifier: Apache-2.0
"""Stage navigate: `Dive` -> `Solution`, every method from the same inputs."""

from abyssnav.navigate.methods import navigate

__all__ = ["navigate"]
