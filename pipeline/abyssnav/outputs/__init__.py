# SPDX-License-Identifier: Apache-2.0
"""What a file or a person gets: tables, messages, recording, report, exports."""
