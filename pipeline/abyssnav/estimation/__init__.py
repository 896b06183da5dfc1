# SPDX-License-Identifier: Apache-2.0
"""Equations: fixes, filters, smoother and their uncertainty.  Arrays in, arrays out."""
