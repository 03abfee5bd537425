/* What both stand-ins share: numbers that a test sets and gets by name, a log of calls, and a clock.
 *
 * A function that a loop calls at each tick stands in the log once between two others. STANDIN_LOG names a file that gets
 * the same, STANDIN_SET sets numbers at the begin ("type=35;buttons=1"), STANDIN_AFTER some time after the device was
 * opened first ("0.5:hand_x=0.01|2:connected=0").
 */
#ifndef STANDIN_H
#define STANDIN_H
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define NUMBERS 64
#define LOG_SIZE 65536

typedef struct {
    const char *name;
    double value;
} number;

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static number numbers[NUMBERS];
static char calls[LOG_SIZE];
static char seen_in_tick[LOG_SIZE];
static double opened_s = -1.0;

static double now_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

static double *cell(const char *name) {
    for (int i = 0; i < NUMBERS; i++) {
        if (!numbers[i].name) {
            numbers[i].name = strdup(name);
            return &numbers[i].value;
        }
        if (!strcmp(numbers[i].name, name)) return &numbers[i].value;
    }
    fprintf(stderr, "stand-in: more than %d numbers\n", NUMBERS);
    abort();
}
#define N(name) (*cell(name))

static void write_log(const char *line) {
    if (strlen(calls) + strlen(line) + 2 < LOG_SIZE) strcat(strcat(calls, line), "\n");
    const char *path = getenv("STANDIN_LOG");
    FILE *file = path ? fopen(path, "a") : NULL;
    if (file) {
        fprintf(file, "%s\n", line);
        fclose(file);
    }
}

/* A call that is made now and then, with what it was called with. */
#define EVENT(...)                                                                                                     \
    do {                                                                                                               \
        char line[256];                                                                                                \
        snprintf(line, sizeof line, __VA_ARGS__);                                                                      \
        seen_in_tick[0] = 0;                                                                                           \
        write_log(line);                                                                                               \
    } while (0)

/* A call that is made at each tick. */
static void tick_call(const char *name) {
    char entry[128];
    snprintf(entry, sizeof entry, "|%s|", name);
    if (strstr(seen_in_tick, entry)) return;
    strcat(seen_in_tick, entry);
    write_log(name);
}

/* "a=1;b=2" */
static void set_all(const char *text) {
    char *copy = strdup(text), *rest = copy, *part;
    while ((part = strsep(&rest, ";"))) {
        char *equals = strchr(part, '=');
        if (!equals) continue;
        *equals = 0;
        N(part) = atof(equals + 1);
    }
    free(copy);
}

static void after_some_time(void) {
    static int done = 0;
    const char *text = getenv("STANDIN_AFTER");
    if (!text || opened_s < 0.0) return;
    /* The one after those that are done. */
    for (int i = 0; i < done && text; i++) text = strchr(text, '|') ? strchr(text, '|') + 1 : NULL;
    if (!text || now_s() < opened_s + atof(text)) return;
    done++;
    char part[256];
    snprintf(part, sizeof part, "%s", strchr(text, ':') + 1);
    part[strcspn(part, "|")] = 0;
    set_all(part);
}

static void defaults(void);

static void set_defaults(void) {
    for (int i = 0; i < NUMBERS; i++) numbers[i].value = 0.0;
    calls[0] = seen_in_tick[0] = 0;
    opened_s = -1.0;
    defaults();
    if (getenv("STANDIN_SET")) set_all(getenv("STANDIN_SET"));
}

__attribute__((constructor)) static void loaded(void) {
    set_defaults();
}

void standin_reset(void) {
    pthread_mutex_lock(&lock);
    set_defaults();
    pthread_mutex_unlock(&lock);
}

static void advance(void);

void standin_set(const char *name, double value) {
    pthread_mutex_lock(&lock);
    advance();
    N(name) = value;
    pthread_mutex_unlock(&lock);
}

double standin_get(const char *name) {
    pthread_mutex_lock(&lock);
    advance();
    double value = N(name);
    pthread_mutex_unlock(&lock);
    return value;
}

const char *standin_log(void) {
    return calls;
}

/* A mass in a hand: m a = F - k (x - target) - b v, by semi-implicit Euler. */
static void move(double *x, double *v, double force, double mass, double k, double target, double b, double dt) {
    *v += dt * (force - k * (*x - target) - b * *v) / mass;
    *x += dt * *v;
}

/* Row-major rotation matrix of the unit quaternion in the numbers qw, qx, qy, qz. */
static void rotation(double m[9]) {
    double w = N("qw"), x = N("qx"), y = N("qy"), z = N("qz");
    double rows[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
    memcpy(m, rows, sizeof rows);
}
#endif
