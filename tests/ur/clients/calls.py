"""Single calls: moves, queries, inputs and outputs."""

import time

import numpy as np
import rtde_control  # type: ignore[import-not-found]  # no stubs
import rtde_io  # type: ignore[import-not-found]
import rtde_receive  # type: ignore[import-not-found]
from tests.ur.clients.scenario import START, Result, scenario


def seen() -> None:
    """Wait for a state newer than an answer: the two use different connections."""
    time.sleep(0.02)


@scenario
def moves(host: str) -> Result:
    """Run moves, synchronous and asynchronous, along paths; then end them in each way."""
    control = rtde_control.RTDEControlInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    result: Result = {}
    away = [*START[:5], 0.3]
    result["movej"] = control.moveJ(away, 2.0, 8.0)
    seen()
    result["q"] = receive.getActualQ()
    result["movej_back"] = control.moveJ(list(START), 2.0, 8.0)
    seen()
    pose = receive.getActualTCPPose()
    up = [*pose[:2], pose[2] + 0.05, *pose[3:]]
    result["movel"] = control.moveL(up, 0.5, 4.0)
    seen()
    result["off_m"] = float(np.abs(np.subtract(receive.getActualTCPPose(), up)).max())
    result["movej_ik"] = control.moveJ_IK(pose, 2.0, 8.0)
    result["movel_fk"] = control.moveL_FK(list(START), 0.5, 4.0)
    result["async"] = control.moveJ(away, 0.1, 8.0, True)  # 3 s, of which a busy machine may take some
    time.sleep(0.1)
    result["running"] = control.getAsyncOperationProgress()
    control.stopJ(2.0)
    result["stopped_at"] = receive.getActualQ()[5]
    result["ended"] = control.getAsyncOperationProgress()
    result["path"] = control.moveJ([[*START, 2.0, 8.0, 0.02], [*away, 2.0, 8.0, 0.0]])
    seen()
    result["path_end"] = receive.getActualQ()
    result["custom"] = control.sendCustomScriptFunction("custom", "  set_standard_digital_out(3, True)\n")
    seen()
    result["digital"] = receive.getActualDigitalOutputBits()
    control.stopScript()
    result["runtime_state"] = receive.getRuntimeState()
    return result


@scenario
def questions(host: str) -> Result:
    """Query settings and requests."""
    control = rtde_control.RTDEControlInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    pose = receive.getActualTCPPose()
    result: Result = {"pose": pose}
    result["inverse"] = control.getInverseKinematics(pose)
    result["inverse_near"] = control.getInverseKinematics(pose, list(START), 1e-10, 1e-10)
    result["solution"] = control.getInverseKinematicsHasSolution(pose)
    result["no_solution"] = control.getInverseKinematicsHasSolution([2.0, 2.0, 2.0, 0.0, 0.0, 0.0])
    result["set_tcp"] = control.setTcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    result["tcp"] = control.getTCPOffset()
    seen()
    result["tool_pose"] = receive.getActualTCPPose()
    result["payload"] = control.setPayload(1.5, [0.0, 0.0, 0.05])
    seen()
    result["payload_kg"] = receive.getPayload()
    result["zero"] = control.zeroFtSensor()
    seen()
    result["force"] = receive.getActualTCPForce()
    control.getStepTime()
    # The client reads the answer before the controller has written it: the second read is valid.
    time.sleep(0.02)
    result["step_time"] = control.getStepTime()
    result["steady"] = control.isSteady()
    result["within"] = [control.isJointsWithinSafetyLimits(list(START)), control.isPoseWithinSafetyLimits(pose)]
    result["forward"] = control.getForwardKinematics()
    result["jog"] = control.jogStart([0.0, 0.0, 0.02, 0.0, 0.0, 0.0], 0, 0.5)
    time.sleep(0.3)
    result["jog_speed"] = receive.getActualTCPSpeed()
    result["jog_stop"] = control.jogStop()
    result["contact"] = [
        control.startContactDetection(),
        control.readContactDetection(),
        control.stopContactDetection(),
    ]
    control.stopScript()
    return result


@scenario
def io(host: str) -> Result:
    """Set digital and analog outputs and the speed slider, with a second client."""
    inputs_outputs = rtde_io.RTDEIOInterface(host)
    receive = rtde_receive.RTDEReceiveInterface(host)
    result: Result = {
        "set": [
            inputs_outputs.setStandardDigitalOut(3, True),
            inputs_outputs.setConfigurableDigitalOut(1, True),
            inputs_outputs.setToolDigitalOut(0, True),
            inputs_outputs.setSpeedSlider(0.5),
            inputs_outputs.setAnalogOutputVoltage(0, 0.25),
            inputs_outputs.setAnalogOutputCurrent(1, 0.5),
            inputs_outputs.setInputIntRegister(20, 5),
            inputs_outputs.setInputDoubleRegister(20, 0.5),
        ]
    }
    time.sleep(0.05)
    result["bits"] = receive.getActualDigitalOutputBits()
    result["slider"] = receive.getTargetSpeedFraction()
    result["analog"] = [receive.getStandardAnalogOutput0(), receive.getStandardAnalogOutput1()]
    inputs_outputs.setStandardDigitalOut(3, False)
    time.sleep(0.05)
    result["cleared"] = receive.getActualDigitalOutputBits()
    return result


@scenario
def slider(host: str) -> Result:
    """Return the position of the speed slider for the next client."""
    return {"seen": rtde_receive.RTDEReceiveInterface(host).getTargetSpeedFraction()}


@scenario
def custom(host: str, upper: bool, body: str) -> Result:
    """Run a program of the user, and a move after it."""
    flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
    if upper:
        flags |= rtde_control.RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
    control = rtde_control.RTDEControlInterface(host, -1.0, flags)
    return {"returned": control.sendCustomScriptFunction("custom", body), "moved": control.moveJ(list(START), 2.0, 8.0)}
