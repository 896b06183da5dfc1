# SPDX-License-Identifier: Apache-2.0
"""`python -m pipeline` is the command `abyssnav`."""

from pipeline.cli import main

main()
