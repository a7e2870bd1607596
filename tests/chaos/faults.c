/* Faults by LD_PRELOAD, for what no test can bring about from outside.
 *
 * - Who opens a file whose name ends in FAULT_FILE meets what FAULT says: "crash" (a segmentation
 *   fault), "hang" (an endless wait), "slow" (half a second's) or "eat" (all memory that there is).
 * - The wall clock is off by as many seconds as the file CLOCK_OFFSET says.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static void befall(const char* path) {
    const char *file = getenv("FAULT_FILE"), *fault = getenv("FAULT");
    char real[4096];
    if (!path || !file || !fault) return;
    /* What was opened already without being read, to be sure that no link is followed. */
    const ssize_t size = strncmp(path, "/proc/", 6) ? -1 : readlink(path, real, sizeof real - 1);
    if (size >= 0) {
        real[size] = 0;
        path = real;
    }
    if (strlen(path) < strlen(file)) return;
    if (strcmp(path + strlen(path) - strlen(file), file) != 0) return;
    if (strcmp(fault, "crash") == 0) raise(SIGSEGV);
    if (strcmp(fault, "hang") == 0)
        for (;;) pause();
    if (strcmp(fault, "slow") == 0) usleep(500000);
    if (strcmp(fault, "eat") == 0)
        for (;;) {
            char* more = malloc(1 << 24);
            if (!more) abort(); /* as what does not check its allocations ends */
            memset(more, 1, 1 << 24);
        }
}

#define OPENS(name)                                                  \
    int name(const char* path, int flags, ...) {                     \
        va_list rest;                                                \
        va_start(rest, flags);                                       \
        const int mode = va_arg(rest, int);                          \
        va_end(rest);                                                \
        befall(path);                                                \
        return ((int (*)(const char*, int, int))dlsym(RTLD_NEXT, #name))(path, flags, mode); \
    }
OPENS(open)
OPENS(open64)

#define STREAMS(name)                                                \
    FILE* name(const char* path, const char* mode) {                 \
        befall(path);                                                \
        return ((FILE * (*)(const char*, const char*)) dlsym(RTLD_NEXT, #name))(path, mode); \
    }
STREAMS(fopen)
STREAMS(fopen64)

static double offset(void) {
    static int (*real_open)(const char*, int, ...);
    const char* file = getenv("CLOCK_OFFSET");
    char text[32] = "0";
    if (!file) return 0;
    if (!real_open) real_open = (int (*)(const char*, int, ...))dlsym(RTLD_NEXT, "open");
    const int from = real_open(file, O_RDONLY);
    if (from < 0) return 0;
    const ssize_t size = read(from, text, sizeof text - 1);
    close(from);
    text[size > 0 ? size : 0] = 0;
    return atof(text);
}

int gettimeofday(struct timeval* restrict now, void* restrict zone) {
    struct timespec real;
    (void)zone;
    ((int (*)(clockid_t, struct timespec*))dlsym(RTLD_NEXT, "clock_gettime"))(CLOCK_REALTIME, &real);
    now->tv_sec = real.tv_sec + (time_t)offset();
    now->tv_usec = real.tv_nsec / 1000;
    return 0;
}

time_t time(time_t* into) {
    struct timeval now;
    gettimeofday(&now, NULL);
    if (into) *into = now.tv_sec;
    return now.tv_sec;
}
