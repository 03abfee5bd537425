"""`haptether demo`."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro

from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from haptether.cli.shared.screen import Screen
    from haptether.cli.shared.stop import Stopped
    from haptether.studies import DemoScene, FollowScene, PickScene, PushResult


Result = TypeVar("Result")

OWN_FOLDER = Path("out/demo")
"""Default folder of the files."""


@dataclass(frozen=True, kw_only=True)
class Demo(PictureOptions):
    """Watch a remote push reach a hand, with and without protection, or a hand pick something up, over real sockets.

    Starts slave, network and master as three processes on this machine: 50 ms each way with a standard deviation of 5
    ms, and 1 % loss. A simulated hand presses a remote wall, something shoves the remote arm, and the hand lets go:
    once without a controller and once with each. Takes about 25 s. Exit status 0: the hand was slower with HSC and with
    WSC than without a controller.

    --task pick: 20 ms each way with a standard deviation of 1 ms, and 1 % loss. A simulated hand leads position,
    orientation and gripper of the arm. It picks something up, turns it by 60 degrees and puts it down beside its first
    place. Takes about 15 s. Exit status 0: it did.

    --master dynamixel: an emulated leader arm of servos, whose joints a scripted hand leads. With --slave ur or
    simulated it picks something up, as --task pick. With --slave dynamixel, an emulated follower, 20 ms each way: its
    gripper takes something, six joints carry it, and it is let go. Then the follower is pushed and the hand lets go of
    the leader, without a controller and with each. Takes about 50 s. Exit status 0 of the latter: each run carried the
    object, and the leader was thrown slower with HSC and with WSC than without a controller.

    Examples:

    haptether demo

    haptether demo --delay-s 0.02 --jitter-s 0.001 --loss 0 --out out/fast-link --json -

    haptether demo --coupling pspm

    haptether demo --slave ur

    haptether demo --slave ur --task pick

    haptether demo --master dynamixel --slave ur

    haptether demo --master dynamixel --slave dynamixel
    """

    delay_s: float | None = None
    """One-way delay in s; by default 0.05, with --task pick 0.02."""
    jitter_s: float | None = None
    """Standard deviation of the delay in s; by default 0.005, with --task pick 0.001."""
    loss: float = 0.01
    """Share of packets lost."""
    seed: int = 1
    """Seed of jitter and loss, 0 to 2^64 - 1."""
    master: Literal["simulated", "dynamixel"] = "simulated"
    """The model of a device; or an emulated leader arm of Dynamixel servos, behind its driver."""
    slave: Literal["simulated", "ur", "dynamixel"] = "simulated"
    """The model of an arm; an emulated UR controller, driven by the vendor's own client library (extra "ur"); or an
    emulated follower arm of Dynamixel servos."""
    task: Literal["push", "pick"] | None = None
    """A push that reaches the hand, or an object that a gripper picks up; by default the task that both arms can do."""
    coupling: str | None = None
    """Coupling of the push, of those of `haptether list`, with gains that the pair bears over this network; by default
    position-force."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Folder of the picture and of every tick (.npz), empty or new; or the picture (.png, .pdf, .svg), with a folder
    beside it. By default out/demo, where a demo replaces the files of the previous demo."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Also write the table as JSON; - for standard output."""

    def run(self) -> int:
        """Run all controllers; 0 if protection held, 1 if not, 130 on Ctrl-C."""
        import msgspec

        from haptether.cli.shared.numbers import check_seed
        from haptether.cli.shared.output import check_target
        from haptether.cli.shared.screen import screen
        from haptether.extras import require
        from haptether.netsim import LinkSettings, link_spec
        from haptether.studies import DEMO_CONTROLLERS, DemoScene, FollowScene, PickScene, run_demo
        from haptether.studies.demo import with_coupling

        check_seed(self.seed)
        check_target(self.json, force=self.force)
        times = {"delay_s": self.delay_s, "jitter_s": self.jitter_s}
        given = {name: value for name, value in times.items() if value is not None}
        task = self._task()
        if self.slave == "ur":
            require("--slave ur", "casadi", "daqp", "rtde_control")
        if "dynamixel" in {self.master, self.slave}:
            require("an arm of servos", "casadi", extra="dynamixel")
        scene: DemoScene | PickScene | FollowScene
        if self.slave == "dynamixel":
            scene = FollowScene(loss=self.loss, seed=self.seed)
        elif task == "pick":
            scene = PickScene(loss=self.loss, seed=self.seed, slave=self.slave, master=self.master)
        else:
            scene = DemoScene(loss=self.loss, seed=self.seed, slave=self.slave)
        scene = msgspec.structs.replace(scene, **given)
        if self.coupling is not None:
            if not isinstance(scene, DemoScene):
                message = f"coupling = {self.coupling}: of the push with a simulated master only: leave it out"
                raise ValueError(message)
            scene = with_coupling(scene, self.coupling)
        # Refuses early.
        link_spec(LinkSettings(delay_s=scene.delay_s, jitter_s=scene.jitter_s, loss=scene.loss), "forward")
        self._picture("demo")  # Refuses a bad path before the runs.
        self._make_folder()
        if isinstance(scene, FollowScene):
            return self._follow(scene)
        if isinstance(scene, PickScene):
            return self._pick(scene)
        console = screen(self.json)
        arm = "an emulated UR controller - ur-rtde - " if self.slave == "ur" else ""
        console.print(
            f"{arm}slave - network ({scene.delay_s * 1e3:g} ms, sigma {scene.jitter_s * 1e3:g} ms, each way, "
            f"{self.loss:.1%} loss) - master,\n  as processes on this machine; "
            f"the hand presses; at {scene.push_at_s:g} s {scene.push_force_n:g} N shove the arm,\n  "
            f"at {scene.release_at_s:g} s the hand lets go",
            highlight=False,
        )
        if scene.gains:
            console.print(f"  {', '.join(scene.gains)}", highlight=False)
        runs = [partial(run_demo, scene, controller) for controller in DEMO_CONTROLLERS]
        results = self._results(console, scene.duration_s, runs)
        return 130 if results is None else self._report(console, scene, results)

    def _results(
        self,
        console: "Screen",
        lasts_s: float,
        runs: "Sequence[Callable[[Path, Callable[[str, float], None], Stopped], Result]]",
    ) -> "list[Result] | None":
        """Return the results of the runs, with a progress bar; None after Ctrl-C."""
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        from haptether.cli.shared.stop import Stopped
        from haptether.studies import Interrupted

        columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
        results = []
        with Stopped() as stopped, Progress(*columns, console=console) as progress:
            bar = progress.add_task("", total=len(runs) * lasts_s)
            for number, run in enumerate(runs):

                def show(stage: str, at_s: float, begun: float = number * lasts_s) -> None:
                    progress.update(bar, completed=begun + at_s, description=f"{stage:<34}")

                try:
                    results.append(run(self._folder, show, stopped))
                except Interrupted:
                    console.print("interrupted: all processes have ended")
                    return None
            progress.update(bar, completed=len(runs) * lasts_s)
        return results

    @property
    def _folder(self) -> Path:
        """Folder of the ticks: `--out`, or beside a picture that `--out` names, a folder of the same name."""
        return self._out.with_suffix("") if self._is_picture else self._out

    @property
    def _out(self) -> Path:
        return OWN_FOLDER if self.out is None else self.out

    @property
    def _is_picture(self) -> bool:
        return bool(self._out.suffix) and not self._out.is_dir()

    def _make_folder(self) -> None:
        """Make the folder of the ticks.

        Raises:
            FileExistsError: The user's own folder is not empty, and `--force` was not given.
        """
        folder = self._folder
        folder.mkdir(parents=True, exist_ok=True)
        if self.out is not None and not self.force and any(folder.iterdir()):
            message = (
                f"{folder}: has files already: --force replaces those that the demo writes, or give another folder"
            )
            raise FileExistsError(message)

    def _picture(self, name: str) -> Path | None:
        """Return the path of the picture; None without matplotlib.

        Raises:
            ValueError: `--out` ends in a suffix that is not a picture's.
            OSError: The picture that `--out` names cannot be written.
        """
        from haptether.cli.shared.picture import picture_file
        from haptether.extras import is_installed

        if not is_installed("matplotlib"):
            return None
        if not self._is_picture:
            return self._folder / f"{name}.{self.format or 'png'}"
        return picture_file(self._out, self.format, force=self.force)

    def _name_picture(self, console: "Screen", picture: Path | None) -> None:
        from haptether.extras import missing

        found = f"picture: {picture}" if picture is not None else f"no picture: {missing('drawing', 'matplotlib')}"
        console.print(found, highlight=False)

    def _task(self) -> str:
        """Return the name of the task that is shown.

        Raises:
            ValueError: Two arms, or an arm and a task, that do not go together.
        """
        if self.slave == "dynamixel":
            if self.master != "dynamixel":
                message = f"master = {self.master}: must be dynamixel with --slave dynamixel, joint for joint"
                raise ValueError(message)
            if self.task is not None:
                message = f"task = {self.task}: --slave dynamixel shows both in one: leave --task out"
                raise ValueError(message)
            return "push"
        if self.master == "dynamixel" and self.task == "push":
            message = f"task = push: --master dynamixel leads --slave {self.slave} as a pose: must be pick"
            raise ValueError(message)
        return self.task or ("pick" if self.master == "dynamixel" else "push")

    def _follow(self, scene: "FollowScene") -> int:
        from haptether.cli.shared.output import write_report
        from haptether.cli.shared.screen import screen
        from haptether.studies import FOLLOW_CONTROLLERS, draw_follow, run_follow

        console = screen(self.json)
        console.print(
            f"an emulated follower arm - slave - network ({scene.delay_s * 1e3:g} ms, sigma "
            f"{scene.jitter_s * 1e3:g} ms, each way, {self.loss:.1%} loss) - master -\n"
            f"  an emulated leader arm, as processes on this machine; the hand closes the gripper on something,\n"
            f"  carries it with six joints and lets it go; at {scene.push_at_s:g} s {scene.push_nm:g} N m push the "
            f"follower,\n  at {scene.release_at_s:g} s the hand lets go of the leader",
            highlight=False,
        )
        runs = [partial(run_follow, scene, controller) for controller in FOLLOW_CONTROLLERS]
        results = self._results(console, scene.duration_s, runs)
        if results is None:
            return 130
        picture = self._picture("follow")
        if picture is not None:
            draw_follow(scene, results, self._folder, picture, self.page_columns)
        bare, *guarded = results
        protected = all(one.thrown_rad_s < bare.thrown_rad_s for one in guarded) and not any(r.holds for r in results)
        carried = all(one.is_carried for one in results)
        report = {"scene": scene, "protected": protected, "carried": carried, "picture": picture and str(picture)}
        write_report(self.json, {**report, "results": results})
        for one in results:
            console.print(
                f"{one.controller}: {'carried' if one.is_carried else 'NOT carried as it was led'}: gripped "
                f"{one.grips} time(s) with {one.grip_n:.1f} N, of which the finger felt {one.finger_n:.1f} N; six "
                f"joints led by {one.led_rad:.3f} rad, the follower's came {one.carried_rad:.3f} rad with it"
                f"{', and let go' if one.open_at_end else ', and is still held'}; the push was felt with "
                f"{one.felt_nm:.2f} N m; let go, the joint was thrown at {one.thrown_rad_s:.2f} rad/s; {one.holds} "
                f"holds, {one.final_state} at the end",
                highlight=False,
            )
        self._name_picture(console, picture)
        return 0 if protected and carried else 1

    def _pick(self, scene: "PickScene") -> int:
        from haptether.bridge import load_scene
        from haptether.cli.shared.output import write_report
        from haptether.cli.shared.screen import screen
        from haptether.studies import draw_pick, run_pick

        console = screen(self.json)
        arm = "an emulated UR controller with a Robotiq gripper - ur-rtde - " if self.slave == "ur" else ""
        led = " - an emulated leader arm of servos" if self.master == "dynamixel" else ""
        console.print(
            f"{arm}slave - network ({scene.delay_s * 1e3:g} ms, sigma {scene.jitter_s * 1e3:g} ms, each way, "
            f"{self.loss:.1%} loss) - master{led},\n  as processes on this machine; "
            "the hand goes down, takes something, turns it by 60 degrees and puts it down beside",
            highlight=False,
        )
        results = self._results(console, load_scene("ur_pick").run.duration_s, [partial(run_pick, scene)])
        if results is None:
            return 130
        (result,) = results
        picture = self._picture("pick")
        if picture is not None:
            draw_pick(scene, self._folder, picture, self.page_columns)
        write_report(
            self.json, {"scene": scene, "done": result.is_done, "picture": picture and str(picture), "result": result}
        )
        done = "done" if result.is_done else "NOT done as the hand did it"
        console.print(
            f"{done}: it was gripped {result.grips} time(s), lifted by {result.lifted_m * 1e3:.0f} mm, carried "
            f"{result.carried_m * 1e3:.0f} mm, turned by {result.turned_rad * 57.29577951308232:.1f} degrees"
            f"{', and let go' if result.open_at_end else ', and is still held'}; {result.holds} holds",
            highlight=False,
        )
        self._name_picture(console, picture)
        return 0 if result.is_done else 1

    def _report(self, console: "Screen", scene: "DemoScene", results: "list[PushResult]") -> int:
        from haptether.cli.live.master import print_push
        from haptether.cli.shared.output import write_report
        from haptether.safety import THROWN_SPEED
        from haptether.studies import draw_demo

        print_push(console, results)
        peak = {result.controller: result.peak_hand_speed for result in results}
        broken = [
            result.controller
            for result in results
            if result.final_state not in {"engaged", "stale"} or result.peak_hand_speed is None
        ]
        bare = peak["none"]
        guarded = {name: speed for name in ("wsc", "hsc") if (speed := peak[name]) is not None}
        # A coupling that throws nobody leaves nothing to damp.
        protected = not broken and bare is not None and (bare < THROWN_SPEED or max(guarded.values()) < bare)
        if bare is not None and bare < THROWN_SPEED:
            console.print(
                f"nobody is thrown, also without a controller: {bare:.2f} m/s, below {THROWN_SPEED:g} m/s",
                highlight=False,
            )
            guarded = {}
        for name, speed in guarded.items():
            if bare is not None:
                console.print(
                    f"{name}: the hand is thrown at {speed:.2f} m/s instead of {bare:.2f} m/s "
                    f"({speed / max(bare, 1e-9):.0%})",
                    highlight=False,
                )
        if broken:
            console.print(f"the link did not last in: {', '.join(broken)} (see holds and the final state)")
        picture = self._picture("demo")
        if picture is not None:
            draw_demo(scene, results, self._folder, picture, self.page_columns)
        write_report(
            self.json, {"scene": scene, "protected": protected, "picture": picture and str(picture), "results": results}
        )
        self._name_picture(console, picture)
        return 0 if protected else 1
