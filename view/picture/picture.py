"""One picture of a time: both ends of each run in 3D, with bands of text around them."""

import itertools
import math
from collections.abc import Sequence
from typing import Any, Self, cast

import numpy as np
import numpy.typing as npt

from haptether.view.picture.bands import Bands, Pixels, caption
from haptether.view.picture.cameras import CAMERAS
from haptether.view.picture.gl import PACKAGES, NoGlError, require_gl
from haptether.view.picture.layout import STATIONS, Column, Rectangle, layout, letter_of
from haptether.view.scene3d import colours
from haptether.view.scene3d.description import Description
from haptether.view.scene3d.parts import Part, Station, Trail

Array = npt.NDArray[np.float64]

VIEW_ANGLE = 28.0
"""View angle of the camera in degrees."""
ROOM = 1.06
"""Margin between content and edge of a view, as a factor."""
SAMPLES = 4
"""Samples per pixel of pictures and films, for smooth edges."""
SOFTWARE = ("llvmpipe", "softpipe", "swiftshader")
"""Names of software renderers."""


class Picture:
    """Drawing of run descriptions side by side.

    Args:
        described: Results of `describe`, or of `describe_beside` for several runs.
        size: Width and height in pixels.
        camera: One of `CAMERAS`.
        window: True for a window; otherwise drawn off-screen.

    Raises:
        NoGlError: There is no usable OpenGL.
        ImportError: PyVista is not installed.
        ValueError: There is no such camera.
    """

    def __init__(
        self, described: Sequence[Description], *,
        size: tuple[int, int] = (1280, 720), camera: str = "front", window: bool = False,
    ) -> None:  # fmt: skip
        require_gl(window=window)
        import pyvista

        self.described = tuple(described)
        self.size = size
        self.plotter = cast(
            "Any",
            pyvista.Plotter(
                shape=(1, 2 * len(self.described)),
                off_screen=not window,
                window_size=list(size),
                border=False,
                lighting="none",
            ),
        )
        # The renderer is known only later, and a window on the processor must keep up.
        self.plotter.render_window.SetMultiSamples(0 if window else SAMPLES)
        if not window and not self.plotter.render_window.SupportsOpenGL():
            message = f"OpenGL does not draw here: on Debian or Ubuntu install {PACKAGES}"
            raise NoGlError(message)
        self.plotter.add_light(pyvista.Light(light_type="headlight", intensity=0.48))
        self.plotter.add_light(pyvista.Light(position=(-0.7, 1.0, 1.0), light_type="camera light", intensity=0.7))
        self.time_s = self.described[0].timeline.begin_s
        self._actors: list[tuple[Part, Any]] = []
        self._trails: list[tuple[Trail, Any, Any]] = []
        self._fill_all()
        self._boards: dict[str, _Board] = {}
        self._overlay = self._add_overlay()
        self.camera = _checked(camera)
        self.lay_out(size)

    def keep_up(self) -> None:
        """Adapt an open window to its renderer: smooth edges on a graphics card, 30 Hz on the processor."""
        if any(name in self.plotter.render_window.ReportCapabilities().lower() for name in SOFTWARE):
            # Blending in insertion order saves buffers as large as the window.
            for renderer in self.plotter.renderers:
                renderer.SetUseOIT(False)
        else:
            self.plotter.render_window.SetMultiSamples(SAMPLES)

    def lay_out(self, size: tuple[int, int]) -> None:
        """Fit everything to a size in pixels."""
        self.size = size
        ends = [end for end in STATIONS if any(end in one.views for one in self.described)]
        self.columns = layout(size, len(self.described), ends)
        letter = letter_of(size, len(self.described))
        self.bands = [Bands(one, column, letter) for one, column in zip(self.described, self.columns, strict=True)]
        width, height = size
        for number, column in enumerate(self.columns):
            for place, station in enumerate(STATIONS):
                self.plotter.renderers[2 * number + place].SetDraw(station in column.views)
                if station not in column.views:
                    continue
                view = column.views[station]
                self.plotter.renderers[2 * number + place].SetViewport(
                    view.left / width,
                    1.0 - (view.top + view.height) / height,
                    (view.left + view.width) / width,
                    1.0 - view.top / height,
                )
        for number, column in enumerate(self.columns[1:]):
            self._show_seam(f"seam {number}", Rectangle(column.head.left - 4, 0, 4, height))
        if len(self.columns) == 1 and len(ends) == 2:
            hand, robot = self.columns[0].captions["hand"], self.columns[0].views["robot"]
            self._show_seam(
                "seam", Rectangle(hand.width, hand.top, robot.left - hand.width, hand.height + robot.height)
            )
        for number, (band, column) in enumerate(zip(self.bands, self.columns, strict=True)):
            self._show_band(f"head {number}", column.head, band.head())
            for station in ends:
                shown = caption(
                    self.described[number],
                    station,
                    column.captions[station],
                    letter,
                    self._pixels_per_metre(number, station),
                )
                self._show_band(f"{station} {number}", column.captions[station], shown)
        self.look(self.camera)

    def renew(self, described: Description) -> None:
        """Replace the only description by a later one of the same run."""
        (before,) = self.described
        self.described = (described,)
        if described.parts is before.parts:
            self.bands[0].renew(described)
            return
        for _, actor in self._actors:
            self._remove(actor)
        for _, _, actor in self._trails:
            self._remove(actor)
        self._actors.clear()
        self._trails.clear()
        self._fill_all()
        self.lay_out(self.size)

    def look(self, camera: str) -> None:
        """Look from one of `CAMERAS`.

        Raises:
            ValueError: There is no such camera.
        """
        self.camera = _checked(camera)
        direction = _unit(np.array(CAMERAS[camera]))
        for number, (one, column) in enumerate(zip(self.described, self.columns, strict=True)):
            for place, station in enumerate(STATIONS):
                if station not in one.views:
                    continue
                centre = 0.5 * np.add(*one.views[station])
                at = self.plotter.renderers[2 * number + place].camera
                at.view_angle = VIEW_ANGLE
                at.focal_point = tuple(centre)
                at.position = tuple(centre + direction * self._distance(one, station, column))
                at.up = (0.0, 1.0, 0.0) if camera == "top" else (0.0, 0.0, 1.0)
                self.plotter.renderers[2 * number + place].ResetCameraClippingRange()

    def update(self, time_s: float, note: str = "") -> None:
        """Move everything to its pose at a time in s, without drawing.

        Args:
            time_s: Time shown.
            note: Further text at the foot.
        """
        self.time_s = time_s
        for part, actor in self._actors:
            at = part.pose(time_s)
            is_seen = at is not None and bool(np.isfinite(at).all())
            actor.SetVisibility(is_seen)
            if is_seen:
                actor.user_matrix = at
        for trail, line, actor in self._trails:
            points = trail.until(time_s)
            actor.SetVisibility(len(points) > 1)
            if len(points) > 1:
                line.points = points
                line.lines = np.array([len(points), *range(len(points))])
        for number, (band, column) in enumerate(zip(self.bands, self.columns, strict=True)):
            self._show_band(f"foot {number}", column.foot, band.foot(time_s, note))

    def image(self, time_s: float) -> Pixels:
        """Picture at a time in s, (height, width, 3)."""
        self.update(time_s)
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

        # PyVista's screenshot would render a second time.
        self.plotter.render_window.Render()
        width, height = self.plotter.render_window.GetSize()
        pixels = vtkUnsignedCharArray()
        self.plotter.render_window.GetPixelData(0, 0, width - 1, height - 1, 0, pixels, 0)
        rows: Pixels = vtk_to_numpy(pixels).reshape(height, width, 3)  # type: ignore[no-untyped-call]
        return rows[::-1].copy()

    def time_at(self, x: float, y: float) -> float | None:
        """Time in s at a pixel of a time line, from the upper left; None elsewhere."""
        return next((time_s for band in self.bands if (time_s := band.time_at(x, y)) is not None), None)

    def close(self) -> None:
        """Free the graphics resources."""
        self.plotter.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _fill_all(self) -> None:
        for number, one in enumerate(self.described):
            for place, station in enumerate(STATIONS):
                self._fill(one, station, 2 * number + place)

    def _remove(self, actor: Any) -> None:  # noqa: ANN401  # VTK has no types
        for renderer in self.plotter.renderers:
            if renderer.HasViewProp(actor):
                renderer.remove_actor(actor, render=False)

    def _fill(self, one: Description, station: Station, place: int) -> None:
        import pyvista

        self.plotter.subplot(0, place)
        self.plotter.set_background(colours.GROUND, top="#ffffff", all_renderers=False)
        for part in one.parts:
            if part.station != station:
                continue
            faces = np.insert(part.mesh.triangles, 0, 3, axis=1)
            surface = pyvista.PolyData(part.mesh.points, faces.ravel())
            surface.point_data["Normals"] = part.mesh.normals
            surface.GetPointData().SetActiveNormals("Normals")
            # Arrows are signs: their colour must be visible from every side.
            is_sign = any(part.name.startswith(arrow.name) for arrow in one.arrows)
            actor = pyvista.Actor(mapper=pyvista.DataSetMapper(surface))
            actor.mapper.scalar_visibility = False
            look = actor.prop
            look.color, look.opacity, look.interpolation = part.colour, part.opacity, "gouraud"
            look.ambient, look.diffuse = (0.6, 0.45) if is_sign else (0.38, 0.68)
            look.specular, look.specular_power = (0.0, 1.0) if is_sign else (0.12, 25.0)
            # All meshes are closed. Back faces would cost time, and be drawn twice where parts are transparent.
            look.culling = "back"
            self.plotter.add_actor(actor, reset_camera=False)
            self._actors.append((part, actor))
        for trail in one.trails:
            if trail.station == station:
                line = pyvista.PolyData(np.zeros((2, 3)), lines=np.array([2, 0, 1]))
                actor = self.plotter.add_mesh(
                    line,
                    color=trail.colour,
                    line_width=3,
                    lighting=False,
                    render_lines_as_tubes=True,
                    reset_camera=False,
                )
                self._trails.append((trail, line, actor))

    def _add_overlay(self) -> Any:  # noqa: ANN401  # VTK has no types
        from vtkmodules.vtkRenderingCore import vtkRenderer

        overlay = vtkRenderer()
        overlay.SetLayer(1)
        overlay.InteractiveOff()
        self.plotter.render_window.SetNumberOfLayers(2)
        self.plotter.render_window.AddRenderer(overlay)
        return overlay

    def _show_band(self, name: str, rectangle: Rectangle, pixels: Pixels) -> None:
        if name not in self._boards:
            self._boards[name] = _Board(self._overlay)
        bottom = self.size[1] - rectangle.top - rectangle.height
        self._boards[name].show(pixels, rectangle.left, bottom)

    def _show_seam(self, name: str, rectangle: Rectangle) -> None:
        seam = np.full((rectangle.height, rectangle.width, 3), 0xD5, dtype=np.uint8)
        self._show_band(name, rectangle, seam)

    def _distance(self, one: Description, station: Station, column: Column) -> float:
        """Distance of the camera in m at which all is visible."""
        back, view = _unit(np.array(CAMERAS[self.camera])), column.views[station]
        right = _unit(np.cross([0.0, 0.0, 1.0], back))
        up, slope = np.cross(back, right), math.tan(math.radians(0.5 * VIEW_ANGLE))
        corners = np.array(list(itertools.product(*zip(*one.views[station], strict=True))))
        from_centre = corners - corners.mean(axis=0)
        reach = np.maximum(np.abs(from_centre @ up), np.abs(from_centre @ right) * view.height / view.width)
        return float((from_centre @ back + ROOM * reach / slope).max())

    def _pixels_per_metre(self, number: int, station: Station) -> float:
        """Scale in the middle of a view."""
        one, column = self.described[number], self.columns[number]
        if station not in one.views:
            return math.nan
        seen_m = 2.0 * self._distance(one, station, column) * math.tan(math.radians(0.5 * VIEW_ANGLE))
        return column.views[station].height / seen_m


def _checked(camera: str) -> str:
    if camera not in CAMERAS:
        message = f"camera {camera!r}: must be one of {', '.join(CAMERAS)}"
        raise ValueError(message)
    return camera


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


class _Board:
    """Pixels on the screen, kept by the graphics until replaced."""

    def __init__(self, renderer: Any) -> None:  # noqa: ANN401  # VTK has no types
        from vtkmodules.vtkCommonCore import vtkPoints
        from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkImageData, vtkPolyData
        from vtkmodules.vtkRenderingCore import vtkPolyDataMapper2D, vtkTexture, vtkTexturedActor2D

        self._image = vtkImageData()
        texture = vtkTexture()
        texture.SetInputData(self._image)
        texture.InterpolateOff()
        self._corners = vtkPoints()
        self._corners.SetNumberOfPoints(4)
        quad = vtkCellArray()
        quad.InsertNextCell(4, (0, 1, 2, 3))
        self._sheet = vtkPolyData()
        self._sheet.SetPoints(self._corners)
        self._sheet.SetPolys(quad)
        on_image = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
        self._sheet.GetPointData().SetTCoords(_vtk_array(on_image))
        mapper = vtkPolyDataMapper2D()
        mapper.SetInputData(self._sheet)
        self._actor = vtkTexturedActor2D()
        self._actor.SetTexture(texture)
        self._actor.SetMapper(mapper)
        self._rectangle = (0, 0, 0, 0)
        renderer.AddViewProp(self._actor)

    def show(self, pixels: Pixels, left: int, bottom: int) -> None:
        """Show pixels, (height, width, 3), at a place in pixels from the lower left."""
        height, width, _ = pixels.shape
        flipped = np.ascontiguousarray(pixels[::-1]).reshape(-1, 3)
        self._image.SetDimensions(width, height, 1)
        self._image.GetPointData().SetScalars(_vtk_array(flipped))
        self._image.Modified()
        if (rectangle := (left, bottom, width, height)) != self._rectangle:
            self._rectangle = rectangle
            across, up = (left, left + width, left + width, left), (bottom, bottom, bottom + height, bottom + height)
            for corner, (x, y) in enumerate(zip(across, up, strict=True)):
                self._corners.SetPoint(corner, x, y, 0.0)
            self._corners.Modified()
            self._sheet.Modified()


def _vtk_array(values: npt.NDArray[Any]) -> Any:  # noqa: ANN401  # VTK has no types
    from vtkmodules.util.numpy_support import numpy_to_vtk

    return numpy_to_vtk(values, deep=True)  # type: ignore[no-untyped-call]
