"""Checks for a usable OpenGL; without one VTK would end the process or draw nothing."""

import ctypes
import os
import sys

from haptether.extras import require

PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri"
"""Debian and Ubuntu packages of EGL and of Mesa, which draws on the processor without a graphics card."""
WINDOW_PACKAGES = "libgl1 libglx-mesa0"

MOST_DEVICES = 16
PLATFORM_DEVICE = 0x313F
"""EGL_PLATFORM_DEVICE_EXT."""


class NoGlError(ValueError):
    """There is no usable OpenGL or display."""


def loads(library: str) -> bool:
    """True if a shared library can be loaded."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def egl_draws() -> bool:
    """True if an EGL device initializes. The EGL library alone is a dispatcher on which VTK would crash."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    egl.eglGetProcAddress.restype = pointer
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    egl.eglInitialize.argtypes = [pointer, pointer, pointer]
    egl.eglTerminate.argtypes = [pointer]
    query_at = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    display_at = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not query_at or not display_at:
        return False
    query = ctypes.CFUNCTYPE(ctypes.c_uint, integer, ctypes.POINTER(pointer), ctypes.POINTER(integer))(query_at)
    display_of = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(display_at)
    devices, count = (pointer * MOST_DEVICES)(), integer()
    if not query(MOST_DEVICES, devices, ctypes.byref(count)):
        return False
    for device in devices[: count.value]:
        display = display_of(PLATFORM_DEVICE, device, None)
        if display and egl.eglInitialize(display, None, None):
            egl.eglTerminate(display)
            return True
    return False


def display_problem() -> str:
    """Reason why a window has no display; empty if it has one."""
    if sys.platform in {"win32", "darwin"}:
        return ""
    display = os.environ.get("DISPLAY")
    if not display:
        return "DISPLAY is not set"
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return "libX11.so.6 cannot be loaded: on Debian or Ubuntu install libx11-6"
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XOpenDisplay.argtypes = [ctypes.c_char_p]
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    opened = x11.XOpenDisplay(None)
    if not opened:
        return f"DISPLAY = {display}: no X server answers there"
    x11.XCloseDisplay(opened)
    return ""


def require_gl(*, window: bool = False) -> None:
    """Select off-screen rendering of VTK, or check for a display.

    Args:
        window: True for a window, which needs a display.

    Raises:
        ImportError: PyVista is not installed.
        NoGlError: There is no display for a window, or no OpenGL; the text names the packages.
    """
    require("the view", "pyvista", "PIL", "matplotlib", extra="view")
    if window and (problem := display_problem()):
        message = f"no display ({problem}), so no window: give --screenshot, --movie or --html"
        raise NoGlError(message)
    if sys.platform != "linux":
        return
    if window:
        if not loads("libGL.so.1"):
            message = f"no OpenGL (libGL.so.1 cannot be loaded): on Debian or Ubuntu install {WINDOW_PACKAGES}"
            raise NoGlError(message)
        return
    if egl_draws():
        # Select EGL by name: otherwise VTK first tries an X server and reports its absence.
        os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = "vtkEGLRenderWindow"
    elif loads("libOSMesa.so.8"):
        os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = "vtkOSOpenGLRenderWindow"
    else:
        message = f"no OpenGL (EGL has no device that begins): on Debian or Ubuntu install {PACKAGES}"
        raise NoGlError(message)
