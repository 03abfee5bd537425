"""`haptether playback`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    from haptether.bridge import Scene


@dataclass(frozen=True, kw_only=True)
class Playback(FileOptions):
    """Play the remote force of a recording back to a hand, under safety layer, limiter and ladder.

    The force does not depend on the hand: it is an active force. Without --listen it acts on hand and device of the
    recorded scene in virtual time. With --listen this is the side of the robot, to which a master with any device
    engages: a person presses the clutch there, and the force fades in from zero, from the beginning of the recording.
    It ends like any run of two sides. Ctrl-C on either side fades it to zero.

    Exit status 1: the loop diverged, or the live side failed; 2: the recording cannot be played back.

    Examples:

    haptether playback slave.mcap

    haptether playback slave.mcap --set safety.controllers=[hsc] --plot out

    haptether playback slave.mcap --listen 127.0.0.1:9000 --key arm.key
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """File of `--record` of master or slave."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TABLE.KEY=VALUE")] = ()
    """Change a field of the scene; may be given often. A live master sets its own fields by its own command."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="DIR|PICTURE")] = None
    """In virtual time: draw the run into this folder or as this .png, .pdf or .svg."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.npz")] = None
    """In virtual time: write every signal as a NumPy array."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the result as JSON; - for standard output."""
    listen: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """Play it back live: address to listen on for the master."""
    key: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Live: key file of the secure session, the same at both sides; `haptether keygen` makes one."""
    insecure: bool = False
    """Live: go without a key, in the clear."""
    patience_s: float | None = None
    """Live: give up if no master has come after this time in s; without it, wait for one."""

    def run(self) -> int:
        """Play the recording back.

        Raises:
            ValueError: A recording that cannot be played back, or options of the other mode.
        """
        from haptether.bridge import playback_scene
        from haptether.cli.recording.files import check_files
        from haptether.cli.shared.output import check_distinct, check_target
        from haptether.cli.shared.picture import picture_in

        check_distinct(FILE=self.file, key=self.key, json=self.json, out=self.out)
        check_target(self.json, self.out, force=self.force)
        virtual = {"--plot": self.plot, "--out": self.out}
        live = {"--key": self.key, "--insecure": self.insecure or None, "--patience-s": self.patience_s}
        unused = live if self.listen is None else virtual
        if given := [flag for flag, value in unused.items() if value is not None]:
            way = "without --listen there is no live side" if self.listen is None else "with --listen nothing is drawn"
            message = f"{', '.join(given)}: {way}: leave it out"
            raise ValueError(message)
        if self.out is not None and self.out.suffix != ".npz":
            message = f"{self.out}: must end in .npz"
            raise ValueError(message)
        check_files(self.file)
        picture = None if self.plot is None else picture_in(self.plot, "playback", None, force=self.force)
        scene = playback_scene(self.file, overrides=self.set)
        return self._simulate(scene, picture) if self.listen is None else self._play(self.listen, scene)

    def _simulate(self, scene: "Scene", picture: Path | None) -> int:
        from haptether.bridge import simulate
        from haptether.cli.scene.simulate import Simulate, spinner
        from haptether.cli.shared.screen import screen

        with spinner(f"playing {self.file} back"):
            run = simulate(scene)
        return Simulate(scene="playback", json=self.json, out=self.out, force=self.force).report(
            screen(self.json), run, picture
        )

    def _play(self, listen: str, scene: "Scene") -> int:
        from haptether.cli.live.slave import Slave

        side = Slave(
            listen=listen, key=self.key, insecure=self.insecure, patience_s=self.patience_s, json=self.json,
            force=self.force,
        )  # fmt: skip
        return side.run_scene(scene)
