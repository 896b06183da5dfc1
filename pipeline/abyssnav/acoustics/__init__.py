# SPDX-License-Identifier: Apache-2.0
"""Sound in water: travel times and rays."""
