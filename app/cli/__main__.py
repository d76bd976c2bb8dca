"""``python -m onedemo.app.cli``: the same as the command."""

import sys

from onedemo.app.cli.main import main

sys.exit(main())
