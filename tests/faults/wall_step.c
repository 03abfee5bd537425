/* Steps the wall clock of one process: an hour forward 3 s after its first use, two hours back at 3.5 s.
   Preloaded before the C library; the monotonic clock and every other process stay as they are. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stddef.h>
#include <sys/time.h>
#include <time.h>

typedef int (*clock_fn)(clockid_t, struct timespec *);

static clock_fn real(void) {
    static clock_fn found;
    if (!found) found = (clock_fn)dlsym(RTLD_NEXT, "clock_gettime");
    return found;
}

static long stepped(void) {
    static double begun;
    struct timespec now;
    real()(CLOCK_MONOTONIC, &now);
    double now_s = now.tv_sec + now.tv_nsec * 1e-9;
    if (begun == 0.0) begun = now_s;
    return now_s - begun < 3.0 ? 0 : now_s - begun < 3.5 ? 3600 : -3600;
}

int clock_gettime(clockid_t clock, struct timespec *time) {
    int status = real()(clock, time);
    if (status == 0 && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) time->tv_sec += stepped();
    return status;
}

int gettimeofday(struct timeval *restrict time, void *restrict zone) {
    struct timespec now;
    (void)zone;
    int status = clock_gettime(CLOCK_REALTIME, &now);
    time->tv_sec = now.tv_sec;
    time->tv_usec = now.tv_nsec / 1000;
    return status;
}

time_t time(time_t *room) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (room) *room = now.tv_sec;
    return now.tv_sec;
}
