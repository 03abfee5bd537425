"""`python -m haptether`."""

import os
import sys

if not sys.flags.safe_path and sys.path[:1] == [os.getcwd()]:  # noqa: PTH109  # pathlib would be imported from there
    # `-m` puts the working folder first, where a user's file may shadow a module.
    del sys.path[0]

from haptether.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
