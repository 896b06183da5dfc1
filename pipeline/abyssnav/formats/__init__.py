# SPDX-License-Identifier: Apache-2.0
"""Bytes: MCAP files and message encodings, to columns and back."""
