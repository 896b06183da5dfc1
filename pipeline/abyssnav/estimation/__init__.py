# SPDX-License-Identifier: Apache-2.0
"""Equations: geometry, motion, acoustics, fixes, estimation.  Arrays in, arrays out."""
