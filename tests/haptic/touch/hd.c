/* A stand-in for OpenHaptics HDAPI: the documented functions, a scheduler of 1 kHz, and a device behind them.
 *
 * The device is a mass in a hand's spring. It keeps the last force while its scheduler runs and force output is on, which
 * is the worst that one may do. A value of now that is asked for outside a frame, and frames that are not begun and
 * ended in turn, are errors. Signatures: headers of OpenHaptics 3. Written for tests from the public documents.
 */
#include "../standin.h"

typedef struct {
    unsigned code;
    int internal;
    unsigned device;
} error_info;
typedef unsigned (*scheduled)(void *);

#define HANDLE 0u
#define ERRORS 16
#define HISTORY 4096

static double position[3], velocity[3], exerted[3], requested[3];
static error_info errors[ERRORS];
static int error_count, in_frame;
static pthread_t scheduler;
static scheduled callback;
static void *callback_data;
static unsigned char had_force[HISTORY];

static void defaults(void) {
    set_all("there=1;connected=1;calibration=20480;style=4;rate=1000;real_rate=0;max_force=3.3;continuous=0.88;axes=3;"
            "mass=0.1;hand_k=200;hand_b=8;qw=1");
    memset(position, 0, sizeof position);
    memset(velocity, 0, sizeof velocity);
    memset(exerted, 0, sizeof exerted);
    error_count = in_frame = 0;
}

static void push(unsigned code) {
    if (error_count < ERRORS) errors[error_count++] = (error_info){code, -(int)code, HANDLE};
}

void standin_error(unsigned code) {
    pthread_mutex_lock(&lock);
    push(code);
    pthread_mutex_unlock(&lock);
}

static void advance(void) {
    const char *names[9] = {"x", "y", "z", "fx", "fy", "fz", "vx", "vy", "vz"};
    int on = N("scheduler") && N("output") && N("connected");
    for (int i = 0; i < 3; i++) {
        N(names[i]) = position[i];
        N(names[3 + i]) = on ? exerted[i] : 0.0;
        N(names[6 + i]) = velocity[i];
    }
}

static void device_tick(double dt) {
    const char *axes[3] = {"hand_x", "hand_y", "hand_z"};
    int on = N("output") && N("connected");
    double norm = 0.0;
    for (int i = 0; i < 3; i++) {
        norm += exerted[i] * exerted[i];
        for (int part = 0; part < 10; part++) {
            move(&position[i], &velocity[i], on ? exerted[i] : 0.0, N("mass"), N("hand_k"), N(axes[i]), N("hand_b"),
                 dt / 10);
        }
    }
    N("ticks") += 1;
    had_force[(long)N("ticks") % HISTORY] = on && norm > 0.0;
    if (on && sqrt(norm) > N("largest")) N("largest") = sqrt(norm);
}

/* How many of the last ticks had a force. */
int standin_forced(int of) {
    int count = 0;
    pthread_mutex_lock(&lock);
    for (long i = 0; i < of; i++) count += had_force[((long)N("ticks") - i + HISTORY) % HISTORY];
    pthread_mutex_unlock(&lock);
    return count;
}

static void *run(void *unused) {
    (void)unused;
    struct timespec due;
    clock_gettime(CLOCK_MONOTONIC, &due);
    for (;;) {
        pthread_mutex_lock(&lock);
        double rate = N("real_rate") ? N("real_rate") : N("rate");
        int goes_on = N("scheduler") != 0.0;
        after_some_time();
        if (goes_on) device_tick(1.0 / rate);
        scheduled called = N("hangs") ? NULL : callback;
        pthread_mutex_unlock(&lock);
        if (!goes_on) return NULL;
        if (called && called(callback_data) == 0) {
            pthread_mutex_lock(&lock);
            callback = NULL;
            EVENT("callback: done");
            pthread_mutex_unlock(&lock);
        }
        due.tv_nsec += (long)(1e9 / rate);
        if (due.tv_nsec >= 1000000000L) {
            due.tv_nsec -= 1000000000L;
            due.tv_sec++;
        }
        struct timespec late;
        clock_gettime(CLOCK_MONOTONIC, &late);
        /* What a busy machine has left out is not made up for. */
        if (late.tv_sec > due.tv_sec || (late.tv_sec == due.tv_sec && late.tv_nsec > due.tv_nsec)) due = late;
        else clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
    }
}

unsigned hdInitDevice(const char *name) {
    pthread_mutex_lock(&lock);
    EVENT("hdInitDevice(%s)", name ? name : "NULL");
    unsigned handle = HANDLE;
    if (!N("there") || !N("connected") || (name && strcmp(name, "Left"))) {
        /* Either may be all that says so. */
        if (!N("silent_init")) push(0x302);
        handle = 0xFFFFFFFFu;
    } else {
        N("open") += 1;
        if (opened_s < 0.0) opened_s = now_s();
    }
    pthread_mutex_unlock(&lock);
    return handle;
}
void hdDisableDevice(unsigned device) {
    pthread_mutex_lock(&lock);
    EVENT("hdDisableDevice(%u)", device);
    if (N("open")) N("open") -= 1;
    else push(0x104);
    pthread_mutex_unlock(&lock);
}
void hdMakeCurrentDevice(unsigned device) {
    pthread_mutex_lock(&lock);
    tick_call("hdMakeCurrentDevice");
    if (device != HANDLE) push(0x104);
    pthread_mutex_unlock(&lock);
}
void hdBeginFrame(unsigned device) {
    pthread_mutex_lock(&lock);
    tick_call("hdBeginFrame");
    (void)device;
    if (in_frame) push(0x400);
    if (!N("connected")) push(0x302);
    in_frame = 1;
    memcpy(requested, exerted, sizeof requested);
    pthread_mutex_unlock(&lock);
}
void hdEndFrame(unsigned device) {
    pthread_mutex_lock(&lock);
    tick_call("hdEndFrame");
    (void)device;
    if (!in_frame) push(0x401);
    in_frame = 0;
    memcpy(exerted, requested, sizeof exerted);
    pthread_mutex_unlock(&lock);
}
void hdEnable(unsigned what) {
    pthread_mutex_lock(&lock);
    EVENT("hdEnable(0x%X)", what);
    if (what == 0x4000) N("output") = 1.0;
    else if (what == 0x4001) N("clamping") = 1.0;
    else push(0x100);
    pthread_mutex_unlock(&lock);
}
void hdDisable(unsigned what) {
    pthread_mutex_lock(&lock);
    EVENT("hdDisable(0x%X)", what);
    if (what == 0x4000) N("output") = 0.0;
    pthread_mutex_unlock(&lock);
}
void hdGetIntegerv(unsigned what, int *values) {
    pthread_mutex_lock(&lock);
    switch (what) {
    case 0x2000:
        tick_call("hdGetIntegerv(buttons)");
        if (!in_frame) push(0x102);
        values[0] = (int)N("buttons");
        break;
    case 0x2554: values[0] = (int)N("axes"); break;
    case 0x2555: values[0] = (int)N("style"); break;
    case 0x2600: values[0] = (int)N("rate"); break;
    default: push(0x100);
    }
    pthread_mutex_unlock(&lock);
}
void hdGetDoublev(unsigned what, double *values) {
    pthread_mutex_lock(&lock);
    switch (what) {
    case 0x2051:
        tick_call("hdGetDoublev(velocity)");
        if (!in_frame) push(0x102);
        for (int i = 0; i < 3; i++) values[i] = 1e3 * velocity[i];
        break;
    case 0x2052: {
        tick_call("hdGetDoublev(transform)");
        if (!in_frame) push(0x102);
        double m[9];
        rotation(m);
        if (N("bad_matrix")) m[0] = 3.0;
        for (int column = 0; column < 3; column++) {
            for (int row = 0; row < 3; row++) values[4 * column + row] = m[3 * row + column];
            values[4 * column + 3] = 0.0;
            values[12 + column] = N("nan") ? NAN : 1e3 * position[column];
        }
        values[15] = 1.0;
        break;
    }
    case 0x2603: values[0] = N("max_force"); break;
    case 0x2604: values[0] = N("continuous"); break;
    default: push(0x100);
    }
    pthread_mutex_unlock(&lock);
}
void hdSetDoublev(unsigned what, const double *values) {
    pthread_mutex_lock(&lock);
    tick_call("hdSetDoublev(force)");
    if (what != 0x2700) push(0x100);
    if (!in_frame) push(0x102);
    double norm = sqrt(values[0] * values[0] + values[1] * values[1] + values[2] * values[2]);
    double share = norm > N("max_force") ? N("max_force") / norm : 1.0;
    if (share < 1.0 && !N("clamping")) push(0x201);
    for (int i = 0; i < 3; i++) requested[i] = share * values[i];
    pthread_mutex_unlock(&lock);
}
const char *hdGetString(unsigned what) {
    return what == 0x2501 ? "Touch" : what == 0x2503 ? "3D Systems" : what == 0x2504 ? "220-390-00000" : NULL;
}
error_info hdGetError(void) {
    pthread_mutex_lock(&lock);
    error_info first = {0, 0, HANDLE};
    if (error_count) {
        first = errors[0];
        memmove(errors, errors + 1, --error_count * sizeof *errors);
    }
    pthread_mutex_unlock(&lock);
    return first;
}
unsigned hdCheckCalibration(void) {
    pthread_mutex_lock(&lock);
    tick_call("hdCheckCalibration");
    unsigned status = (unsigned)N("calibration");
    pthread_mutex_unlock(&lock);
    return status;
}
void hdUpdateCalibration(unsigned style) {
    pthread_mutex_lock(&lock);
    EVENT("hdUpdateCalibration(%u)", style);
    if (N("calibration") == 0x5001) N("calibration") = 0x5000;
    pthread_mutex_unlock(&lock);
}
unsigned long hdScheduleAsynchronous(scheduled function, void *data, unsigned short priority) {
    pthread_mutex_lock(&lock);
    EVENT("hdScheduleAsynchronous(priority 0x%X)", priority);
    callback = function;
    callback_data = data;
    pthread_mutex_unlock(&lock);
    return 1;
}
#ifndef WITHOUT_UNSCHEDULE
void hdUnschedule(unsigned long handle) {
    pthread_mutex_lock(&lock);
    EVENT("hdUnschedule(%lu)", handle);
    callback = NULL;
    pthread_mutex_unlock(&lock);
}
#endif
void hdStartScheduler(void) {
    pthread_mutex_lock(&lock);
    EVENT("hdStartScheduler()");
    if (N("no_scheduler")) {
        push(0x304);
    } else {
        N("scheduler") = 1.0;
        if (pthread_create(&scheduler, NULL, run, NULL)) abort();
    }
    pthread_mutex_unlock(&lock);
}
void hdStopScheduler(void) {
    pthread_mutex_lock(&lock);
    EVENT("hdStopScheduler()");
    int ran = N("scheduler") != 0.0;
    N("scheduler") = 0.0;
    pthread_mutex_unlock(&lock);
    if (ran) pthread_join(scheduler, NULL);
}
