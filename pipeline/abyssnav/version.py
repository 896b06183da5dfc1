# SPDX-License-Identifier: Apache-2.0
"""The version, which outputs carry and by which results of another are told."""

__version__ = "1.0.0"
