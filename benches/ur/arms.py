"""Shared by tests and bench of UR kinematics: real calibrations, and the same arms in pinocchio."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio  # type: ignore[import-untyped]

from haptether.slave import UrCalibration, UrModel, ur_model

Array = npt.NDArray[np.float64]

# Calibrations of four arms, as stored in their controllers: from ur_modern_driver's issue 179 (UR5), and from the tests
# of the vendor's ROS driver, ur_calibration/test/calibration_test.cpp (UR10).
CALIBRATIONS: dict[str, tuple[UrModel, UrCalibration]] = {
    "ur5": (
        ur_model("ur5"),
        UrCalibration(
            delta_theta=(
                2.07750978653505926e-05,
                0.96821571555565844,
                -1.85685385014877657,
                0.888647901450376643,
                5.66106814887767484e-05,
                -7.46310764096455082e-05,
            ),
            delta_a=(
                0.000393621049984383038,
                0.184093300397451837,
                0.14493953300732923,
                -6.43297403642304399e-05,
                7.76709040084077299e-06,
                0.0,
            ),
            delta_d=(
                4.00263097760228392e-05,
                278.244144925623573,
                -183.695513914913732,
                -94.5471513669751289,
                0.000304782681775556119,
                0.000123737941387466743,
            ),
            delta_alpha=(
                -0.000271624944216508624,
                0.00125856505456124258,
                -0.00322052070697146503,
                0.00065153016530383745,
                -0.00058700465721117645,
                0.0,
            ),
        ),
    ),
    "ur10 near": (
        ur_model("ur10"),
        UrCalibration(
            delta_theta=(
                -7.290070070824746e-05,
                -0.01713897289704999,
                -0.03707159413492756,
                0.054279462160583214,
                1.488984257025741e-07,
                1.551499479707493e-05,
            ),
            delta_a=(
                4.6311376834935676e-05,
                -0.00012568315331862312,
                0.00186216581161458,
                9.918593870679266e-05,
                4.215462720453189e-06,
                0.0,
            ),
            delta_d=(
                0.00065609212979853,
                1.4442162376284788,
                0.854147723854608,
                -2.2989425877563705,
                -1.573498686836816e-05,
                1.9072435590711256e-05,
            ),
            delta_alpha=(
                0.000211987863869334,
                -0.0072553625957652995,
                -0.013483226769541364,
                0.0013495820227329425,
                -0.001263136163679901,
                0.0,
            ),
        ),
    ),
    "ur10 far": (
        ur_model("ur10"),
        UrCalibration(
            delta_theta=(
                -2.41478068943590252e-07,
                1.60233952386694556,
                -1.68607190752171299,
                0.0837331147700118711,
                -1.01260355871157781e-07,
                3.91986209186123702e-08,
            ),
            delta_a=(
                2.12234865571205891e-05,
                0.632017132627700651,
                0.00229833638891230319,
                -4.61409023720933908e-05,
                -6.39280053471801522e-05,
                0.0,
            ),
            delta_d=(
                -0.000160188285741325043,
                439.140974079900957,
                -446.027059806332147,
                6.88618689642360149,
                -3.86588496858186748e-05,
                -0.00087908274257374186,
            ),
            delta_alpha=(
                -0.000650246557584166496,
                0.00139416666825590402,
                0.00693818880325995126,
                -0.000811641562390219562,
                0.000411120504570705592,
                0.0,
            ),
        ),
    ),
    "ur10 turned": (
        ur_model("ur10"),
        UrCalibration(
            delta_theta=(
                1.59613525316931737e-07,
                -0.917209621528830232,
                7.12936131346499469,
                0.0710299029424392298,
                -1.64258976526054923e-06,
                9.17286101034808787e-08,
            ),
            delta_a=(
                0.000108651068627930392,
                0.240324175250532346,
                0.00180628180213493472,
                2.63076149165684402e-05,
                3.96638632500012715e-06,
                0.0,
            ),
            delta_d=(
                -0.000144894975118076141,
                303.469135666158195,
                -309.88394307789747,
                6.41459904397394975,
                -4.48232900190081995e-05,
                -0.00087071402790364627,
            ),
            delta_alpha=(
                -0.000444781952841921679,
                -0.00160215112531214153,
                0.00631917793331091861,
                -0.00165055247340828437,
                0.000763682515545038854,
                0.0,
            ),
        ),
    ),
}

TOOL = np.array(
    (
        (0.36, 0.48, -0.8, 0.02),
        (-0.8, 0.6, 0.0, -0.03),
        (0.48, 0.64, 0.6, 0.15),
        (0.0, 0.0, 0.0, 1.0),
    )
)


class PinocchioArm:
    """Arm of six revolute joints from its Denavit-Hartenberg rows, in pinocchio."""

    def __init__(self, model: UrModel, calibration: UrCalibration | None, tool: Array) -> None:
        zeros = (0.0,) * 6
        deltas = calibration or UrCalibration()
        rows = zip(
            deltas.delta_theta,
            np.add(model.a, deltas.delta_a),
            np.add(model.d, deltas.delta_d),
            np.add(model.alpha, deltas.delta_alpha),
            strict=True,
        )
        self.model: Any = pinocchio.Model()
        placement, parent = pinocchio.SE3.Identity(), 0
        for number, (theta, a, d, alpha) in enumerate(rows, start=1):
            rotation = pinocchio.SE3(pinocchio.utils.rotate("z", theta), np.zeros(3))
            parent = self.model.addJoint(parent, pinocchio.JointModelRZ(), placement * rotation, f"joint_{number}")
            placement = pinocchio.SE3(pinocchio.utils.rotate("x", alpha), np.array((a, 0.0, d)))
        tool_placement = placement * pinocchio.SE3(tool[:3, :3], tool[:3, 3])
        frame = pinocchio.Frame("tool", parent, tool_placement, pinocchio.FrameType.OP_FRAME)
        self.frame = self.model.addFrame(frame)
        self.data: Any = self.model.createData()
        assert self.model.nq == len(zeros)

    def forward_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Return the tool pose, (4, 4), m, and its Jacobian, (6, 6), in the base frame, for joint angles in rad."""
        frame = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = pinocchio.computeFrameJacobian(self.model, self.data, q, self.frame, frame)
        return self.data.oMf[self.frame].homogeneous, jacobian

    def jacobian_dot(self, q: Array, qd: Array) -> Array:
        """Return the Jacobian's time derivative, (6, 6), at joint angles in rad and velocities in rad/s, (6,) each."""
        frame = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        pinocchio.computeJointJacobiansTimeVariation(self.model, self.data, q, qd)
        pinocchio.updateFramePlacements(self.model, self.data)
        found: Array = pinocchio.getFrameJacobianTimeVariation(self.model, self.data, self.frame, frame)
        return found
