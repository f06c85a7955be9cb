# PYTHON_ARGCOMPLETE_OK
"""`python -m startrack`: the same as the command `startrack`."""

import sys

from startrack.cli.main import main

sys.exit(main())
