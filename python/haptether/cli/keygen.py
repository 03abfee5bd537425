"""`haptether keygen`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Keygen:
    """Make the key that master and slave share: 32 random bytes in a file that only you may read.

    Bring the file to the other side over a channel that nobody else reads, such as scp or a memory stick. The key lets
    its holder move the arm.

    Examples:

    haptether keygen

    haptether keygen /etc/haptether/arm.key --force
    """

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")] = Path("haptether.key")
    """Path of the key file."""
    force: bool = False
    """Replace an existing file; the key in it is lost."""

    def run(self) -> int:
        """Write the file."""
        from haptether.bridge import write_key

        if self.path.is_dir():
            message = f"{self.path}: is a folder, must be a file"
            raise OSError(message)
        write_key(self.path, replace=self.force)
        print(f"{self.path}: a new key, mode 0600; the other side needs the same file")
        return 0
