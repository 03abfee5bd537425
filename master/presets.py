"""Haptic devices that a scene can name, each value with its source.

"Data sheet" is the sheet of SensAble, later 3D Systems, for the device. The sheets were not available: values are as
commonly quoted, with a second source if one was read. Values without a source are marked as chosen, with the method.
Back-drive resistance is taken as Coulomb friction. No data sheet gives viscous friction, so it is taken as zero.
"""

from collections.abc import Mapping
from math import pi
from types import MappingProxyType
from typing import Literal

import msgspec


class DevicePreset(msgspec.Struct, frozen=True, kw_only=True):
    """Known values of a haptic device model, equal on each axis.

    For a device with joints, m is in kg m², forces are in N m and positions in rad.
    """

    title: str
    """Maker and model."""
    mass_kg: float
    """m in kg: apparent mass at the tip."""
    viscous: float
    """b in N s/m."""
    coulomb: float
    """c in N."""
    friction: Literal["vector", "axis"] = "vector"
    """Friction along the motion of a stylus, or on each joint separately."""
    encoder_quantum: float
    """Position resolution in m."""
    max_force_n: float
    """Largest short-time force in N."""
    continuous_force_n: float
    """Continuous force in N; for information, because a simulated device does not heat up."""
    speed_bound: float
    """Speed limit in m/s; a faster, persistent step of the position is a fault."""
    workspace: tuple[float, ...]
    """Width, height and depth of the workspace in m; for information, `stops` of a scene bound it."""


DEVICE_PRESETS: Mapping[str, DevicePreset] = MappingProxyType({
    "phantom-desktop": DevicePreset(
        title="SensAble PHANTOM Desktop",
        # m, b, c: paper section 4.1, identified on the paper's own device. The data sheet gives 45 g and 0.06 N; the
        # paper's m includes the stylus as it was held and thrown.
        mass_kg=0.157,
        viscous=-0.005,
        coulomb=0.038,
        encoder_quantum=2.3e-5,  # data sheet: 0.023 mm (1100 dpi)
        max_force_n=7.9,  # data sheet; CHAI3D (CPhantomDevices.cpp) has the same
        continuous_force_n=1.75,  # data sheet
        speed_bound=10.0,  # chosen: max_force_n throws it at 4.0 m/s over its workspace, a hand at 6 m/s
        workspace=(0.16, 0.12, 0.12),  # data sheet
    ),
    "phantom-omni": DevicePreset(
        title="SensAble PHANTOM Omni",
        mass_kg=0.045,  # data sheet: 45 g apparent mass at the tip
        viscous=0.0,  # in no data sheet
        coulomb=0.26,  # data sheet: back-drive friction below 0.26 N
        encoder_quantum=5.5e-5,  # data sheet: 0.055 mm (450 dpi)
        max_force_n=3.3,  # data sheet; CHAI3D (CPhantomDevices.cpp) has the same
        continuous_force_n=0.88,  # data sheet
        speed_bound=12.0,  # chosen: max_force_n throws it at 4.8 m/s over its workspace, a hand at 6 m/s
        workspace=(0.16, 0.12, 0.07),  # data sheet
    ),
    "touch": DevicePreset(
        title="3D Systems Touch",
        # Successor of the Omni with the same mechanism; assumed to have the Omni's values.
        mass_kg=0.045,
        viscous=0.0,
        coulomb=0.26,
        encoder_quantum=5.5e-5,
        max_force_n=3.3,  # CHAI3D (CPhantomDevices.cpp) has the same
        continuous_force_n=0.88,
        speed_bound=12.0,
        workspace=(0.16, 0.12, 0.07),
    ),
    "phantom-premium-1.5": DevicePreset(
        title="SensAble PHANTOM Premium 1.5",
        mass_kg=0.075,  # data sheet: below 75 g
        viscous=0.0,  # in no data sheet
        coulomb=0.04,  # data sheet: back-drive friction 0.04 N
        encoder_quantum=3e-5,  # data sheet: 0.03 mm (860 dpi)
        max_force_n=8.5,  # data sheet; CHAI3D (CPhantomDevices.cpp, its 6DOF model) has the same
        continuous_force_n=1.4,  # data sheet
        speed_bound=16.0,  # chosen: max_force_n throws it at 9.3 m/s over its workspace, a hand at 6 m/s
        workspace=(0.381, 0.267, 0.191),  # data sheet
    ),
    "inverse3": DevicePreset(
        title="Haply Inverse3",
        # No value of this preset has a source, because the available documentation gives none. Chosen as the identified
        # PHANTOM Desktop, the only desktop device here with measured m, b, c, including its force bound. Replace it by
        # values of your own device.
        mass_kg=0.157,
        viscous=0.0,
        coulomb=0.038,
        encoder_quantum=2.3e-5,
        max_force_n=7.9,
        continuous_force_n=1.75,
        speed_bound=10.0,
        workspace=(0.16, 0.12, 0.12),
    ),
    "dynamixel-leader": DevicePreset(
        title="Joint of a leader arm: ROBOTIS DYNAMIXEL XL330-M288-T at 5 V",
        # m, b, c: identified by Duclusaud et al. 2024 (github.com/Rhoban/bam, bam/params/xl330/m1.json at 11bb7ec:
        # armature, friction_viscous, friction_base), for the servo without load: add the load of the joint. Other fits
        # there differ. Its kt of 0.37 N m/A identifies the M288: the e-manual's 0.52 N m at 1.47 A is 0.354.
        mass_kg=0.00199,  # kg m²
        viscous=0.0059,  # N m s/rad
        coulomb=0.0182,  # N m
        friction="axis",
        encoder_quantum=2.0 * pi / 4096.0,  # rad; e-manual: 4096 pulse/rev
        max_force_n=0.52,  # N m; e-manual: stall torque at 5.0 V
        continuous_force_n=0.104,  # N m; chosen: the e-manual advises loads of a fifth of the stall torque or less
        speed_bound=30.0,  # rad/s; chosen: three times its speed without load, 10.8 rad/s
        workspace=(2.0 * pi,),  # rad; e-manual: position control over 0 to 360 degrees
    ),
})  # fmt: skip
"""Presets by name, as in `[master] device`."""
