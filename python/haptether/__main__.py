"""`python -m haptether`."""

from haptether.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
