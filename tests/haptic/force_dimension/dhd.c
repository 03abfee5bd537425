/* A stand-in for the Force Dimension SDK: the documented functions, and a device behind them.
 *
 * The device is a mass in a hand's spring, with the weight of its arms, and a gripper. Its controller has what the
 * documents say: brakes while forces are off, a watchdog in steps of 125 us, an over-speed stop, a force button. Gravity
 * compensation is computed in the call that sets a force, so it is as old as that.
 * Signatures: dhdc.h of SDK 3.17.5. Written for tests from the public documents.
 */
#include "../standin.h"
#include <stdbool.h>

typedef unsigned char uchar;
typedef unsigned short ushort;
typedef unsigned int uint;

#define STEP_S 1e-4
#define GRAVITY 9.81
#define BRAKE 20.0

static __thread int last_error;
static double position[3], velocity[3], commanded[7], compensation, gap, gap_velocity, advanced_s, last_force_s;
static double earlier[3], earlier_s;
static struct {
    char name[64];
    int times, error;
} failing[4];

static void defaults(void) {
    set_all("devices=1;type=35;watchdog_slack=1;serial=1234;power=1;connected=1;started=1;wrist_started=1;mass=0.2;hand_k=200;hand_b=8;"
            "watchdog_there=1;fastest=2;finger_k=200;finger=0.03;gap_mass=0.05;qw=1;base_angle=0.7");
    memset(position, 0, sizeof position);
    memset(velocity, 0, sizeof velocity);
    memset(commanded, 0, sizeof commanded);
    compensation = gap_velocity = 0.0;
    gap = 0.03;
    advanced_s = now_s();
    memset(failing, 0, sizeof failing);
}

static bool is(int a, int b, int c, int d) {
    int type = (int)N("type");
    return type == a || type == b || type == c || type == d;
}
static bool gripper(void) {
    return is(35, 37, 104, 105);
}

static void off(int cause) {
    N("force") = 0.0;
    N("brake") = 1.0;
    N("cause") = cause;
}

/* What has happened since the last call. */
static void advance(void) {
    after_some_time();
    double now = now_s();
    if (now - advanced_s > 1.0) advanced_s = now - 1.0;
    const char *axes[3] = {"hand_x", "hand_y", "hand_z"};
    for (; advanced_s + STEP_S <= now; advanced_s += STEP_S) {
        double watchdog_s = 125e-6 * N("watchdog") * N("watchdog_slack");
        if (N("force") && watchdog_s > 0.0 && advanced_s - last_force_s > watchdog_s) off(3);
        if (N("force") && N("force_button")) off(1);
        double speed = sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1] + velocity[2] * velocity[2]);
        if (N("force") && speed > N("fastest")) off(2);
        double on = N("force"), b = N("hand_b") + (N("brake") ? BRAKE : 0.0);
        for (int i = 0; i < 3; i++) {
            double weight = i == 2 ? on * compensation - N("weight_kg") * GRAVITY : 0.0;
            move(&position[i], &velocity[i], on * commanded[i] + weight, N("mass"), N("hand_k"), N(axes[i]), b, STEP_S);
        }
        /* A positive force opens the gripper. */
        move(&gap, &gap_velocity, on * commanded[6], N("gap_mass"), N("finger_k"), N("finger"), 4.0, STEP_S);
    }
    const char *names[7] = {"fx", "fy", "fz", "tx", "ty", "tz", "fg"};
    for (int i = 0; i < 7; i++) N(names[i]) = N("force") * commanded[i];
    N("x") = position[0];
    N("y") = position[1];
    N("z") = position[2];
}

static int fail(int error) {
    last_error = error;
    return -1;
}

/* Begins a call: 0, or -1 with its error. */
static int begin(const char *name, char id) {
    advance();
    for (size_t i = 0; i < sizeof failing / sizeof *failing; i++)
        if (failing[i].times > 0 && !strcmp(failing[i].name, name)) {
            failing[i].times--;
            return fail(failing[i].error);
        }
    if (!N("open") || (id != 0 && id != -1)) return fail(15);
    return N("connected") ? 0 : fail(2);
}

#define CALL(name, id, ...) \
    do {                                                                                                               \
        pthread_mutex_lock(&lock);                                                                                     \
        int returned = begin(name, id);                                                                                \
        if (returned == 0) __VA_ARGS__ pthread_mutex_unlock(&lock);                                                           \
        return returned;                                                                                               \
    } while (0)

/* The next calls of a function fail. */
void standin_fail(const char *name, int error, int times) {
    pthread_mutex_lock(&lock);
    for (size_t i = 0; i < sizeof failing / sizeof *failing; i++)
        if (failing[i].times <= 0) {
            snprintf(failing[i].name, sizeof failing[i].name, "%s", name);
            failing[i].error = error;
            failing[i].times = times;
            break;
        }
    pthread_mutex_unlock(&lock);
}

int dhdErrorGetLast(void) {
    return last_error;
}
const char *dhdErrorGetLastStr(void) {
    static const char *texts[] = {"no error", "undocumented error", "communication error", "controller busy",
                                  "no driver found", "no device found", "not available", "timeout"};
    return last_error < 8 ? texts[last_error] : last_error == 19 ? "not enabled" : "another error";
}
int dhdGetDeviceCount(void) {
    EVENT("dhdGetDeviceCount()");
    return (int)N("devices");
}
static int open_device(void) {
    if (!N("devices")) return fail(5);
    if (N("in_use")) return fail(20);
    if (!N("connected")) return fail(5);
    N("open") += 1;
    if (opened_s < 0.0) opened_s = now_s();
    return 0;
}
int dhdOpenID(char id) {
    pthread_mutex_lock(&lock);
    EVENT("dhdOpenID(%d)", id);
    int returned = open_device();
    pthread_mutex_unlock(&lock);
    return returned;
}
int dhdOpenSerial(int serial) {
    pthread_mutex_lock(&lock);
    EVENT("dhdOpenSerial(%d)", serial);
    int returned = serial == (int)N("serial") ? open_device() : fail(5);
    pthread_mutex_unlock(&lock);
    return returned;
}
int dhdClose(char id) {
    pthread_mutex_lock(&lock);
    EVENT("dhdClose()");
    int returned = N("open") ? 0 : fail(15);
    if (N("open")) N("open") -= 1;
    (void)id;
    pthread_mutex_unlock(&lock);
    return returned;
}
int dhdStop(char id) {
    CALL("dhdStop", id, {
        EVENT("dhdStop()");
        off(4);
    });
}
int dhdEnableForce(uchar on, char id) {
    CALL("dhdEnableForce", id, {
        EVENT("dhdEnableForce(%d)", on);
        memset(commanded, 0, sizeof commanded);
        if (!on) off(4);
        else if (!N("force_button")) {
            N("force") = 1.0;
            N("brake") = N("cause") = 0.0;
            last_force_s = now_s();
        }
    });
}
int dhdGetSystemType(char id) {
    CALL("dhdGetSystemType", id, { returned = (int)N("type"); });
}
const char *dhdGetSystemName(char id) {
    (void)id;
    return is(33, 33, 33, 33) ? "omega.3" : is(35, 37, 35, 37) ? "omega.7" : is(104, 105, 104, 105) ? "sigma.7" : "?";
}
int dhdGetSerialNumber(ushort *serial, char id) {
    CALL("dhdGetSerialNumber", id, { *serial = (ushort)N("serial"); });
}
int dhdGetStatus(int status[17], char id) {
    CALL("dhdGetStatus", id, {
        tick_call("dhdGetStatus");
        memset(status, 0, 17 * sizeof(int));
        status[0] = (int)N("power");
        status[1] = (int)N("connected");
        status[2] = (int)N("started");
        status[3] = (int)N("reset");
        status[4] = !N("force");
        status[5] = (int)N("force");
        status[6] = (int)N("brake");
        status[9] = (int)N("error");
        status[10] = (int)N("gravity");
        status[12] = (int)N("wrist_started");
        status[14] = (int)N("cause");
    });
}
int dhdGetDeviceAngleRad(double *angle, char id) {
    CALL("dhdGetDeviceAngleRad", id, { *angle = N("base_angle"); });
}
bool dhdHasWrist(char id) {
    (void)id;
    return is(34, 36, 35, 37) || is(104, 105, 104, 105);
}
bool dhdHasActiveWrist(char id) {
    (void)id;
    return is(104, 105, 104, 105);
}
bool dhdHasGripper(char id) {
    (void)id;
    return gripper();
}
bool dhdHasActiveGripper(char id) {
    (void)id;
    return gripper();
}
int dhdSetGravityCompensation(int on, char id) {
    CALL("dhdSetGravityCompensation", id, {
        EVENT("dhdSetGravityCompensation(%d)", on);
        N("gravity") = on;
    });
}
int dhdSetEffectorMass(double mass, char id) {
    CALL("dhdSetEffectorMass", id, {
        EVENT("dhdSetEffectorMass(%g)", mass);
        N("effector_kg") = mass;
    });
}
uint dhdGetButtonMask(char id) {
    (void)id;
    tick_call("dhdGetButtonMask");
    return (uint)N("buttons");
}
static int read_position(double *x, double *y, double *z) {
    *x = N("nan") ? NAN : N("position_scale") ? N("position_scale") * position[0] : position[0];
    *y = position[1];
    *z = position[2];
    memcpy(earlier, position, sizeof earlier);
    earlier_s = now_s();
    return N("timeguard") ? 1 : 0;
}
int dhdGetPosition(double *x, double *y, double *z, char id) {
    CALL("dhdGetPosition", id, {
        tick_call("dhdGetPosition");
        returned = read_position(x, y, z);
    });
}
int dhdGetPositionAndOrientationFrame(double *x, double *y, double *z, double matrix[9], char id) {
    CALL("dhdGetPositionAndOrientationFrame", id, {
        tick_call("dhdGetPositionAndOrientationFrame");
        rotation(matrix);
        if (N("bad_matrix")) matrix[0] = 3.0;
        returned = read_position(x, y, z);
    });
}
int dhdGetLinearVelocity(double *x, double *y, double *z, char id) {
    CALL("dhdGetLinearVelocity", id, {
        tick_call("dhdGetLinearVelocity");
        *x = velocity[0];
        *y = velocity[1];
        *z = velocity[2];
    });
}
int dhdGetGripperGap(double *opening, char id) {
    CALL("dhdGetGripperGap", id, {
        tick_call("dhdGetGripperGap");
        if (!gripper()) returned = fail(6);
        *opening = N("nan_gap") ? NAN : gap;
    });
}
static int set_wrench(const double wrench[7]) {
    if (!N("force")) return fail(19);
    double norm = 0.0;
    memcpy(commanded, wrench, sizeof commanded);
    for (int i = 0; i < 3; i++) norm += wrench[i] * wrench[i];
    if (sqrt(norm) > N("largest")) N("largest") = sqrt(norm);
    compensation = N("gravity") ? N("weight_kg") * GRAVITY : 0.0;
    last_force_s = now_s();
    return N("saturated") ? 2 : 0;
}
int dhdSetForce(double fx, double fy, double fz, char id) {
    CALL("dhdSetForce", id, {
        tick_call("dhdSetForce");
        double wrench[7] = {fx, fy, fz, 0, 0, 0, 0};
        returned = set_wrench(wrench);
    });
}
int dhdSetForceAndTorqueAndGripperForce(double fx, double fy, double fz, double tx, double ty, double tz, double fg,
                                        char id) {
    CALL("dhdSetForceAndTorqueAndGripperForce", id, {
        tick_call("dhdSetForceAndTorqueAndGripperForce");
        double wrench[7] = {fx, fy, fz, tx, ty, tz, fg};
        returned = set_wrench(wrench);
    });
}
int dhdEnableExpertMode(void) {
    EVENT("dhdEnableExpertMode()");
    N("expert") = 1.0;
    return 0;
}
#ifndef WITHOUT_WATCHDOG
int dhdSetWatchdog(uchar steps, char id) {
    CALL("dhdSetWatchdog", id, {
        EVENT("dhdSetWatchdog(%d)", steps);
        if (!N("expert")) returned = fail(9);
        else if (!N("watchdog_there")) returned = fail(6);
        else N("watchdog") = N("watchdog_rounds") ? 8 * (steps / 8) : steps;
    });
}
#endif
int dhdGetWatchdog(uchar *steps, char id) {
    CALL("dhdGetWatchdog", id, {
        EVENT("dhdGetWatchdog()");
        *steps = (uchar)N("watchdog");
    });
}
