"""`python -m gsvis` is `gsvis`."""

import sys

from gsvis.cli import main

sys.exit(main())
