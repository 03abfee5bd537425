"""`python -m tests.images [--out DIR] [PICTURE...]`."""

import argparse
from pathlib import Path

from tests.images.makers import MAKERS, ROOT
from tests.images.numbers import keep


def main() -> None:
    """Generate the named pictures, or all."""
    options = argparse.ArgumentParser(description="Makes the pictures of the documents anew.")
    options.add_argument("--out", metavar="DIR", type=Path, default=ROOT / "docs" / "images")
    options.add_argument("pictures", metavar="PICTURE", nargs="*", help=f"one of {', '.join(MAKERS)}; by default all")
    given = options.parse_args()
    if unknown := set(given.pictures) - set(MAKERS):
        options.error(f"{', '.join(sorted(unknown))}: must be of {', '.join(MAKERS)}")
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.pictures or MAKERS:
        print(name, flush=True)
        MAKERS[name]((given.out / name).resolve())
    if given.out.resolve() == ROOT / "docs" / "images":
        keep([given.out / name for name in given.pictures or MAKERS])


if __name__ == "__main__":
    main()
