# SPDX-License-Identifier: Apache-2.0
"""`python -m abyssnav` is the command `abyssnav`."""

from abyssnav.cli import main

if __name__ == "__main__":  # a worker of `batch` imports this module too
    main()
