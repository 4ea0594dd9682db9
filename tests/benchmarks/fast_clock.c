/* A faster clock for one process, loaded with LD_PRELOAD: every clock and every wait of the C library.
 *
 * All wall clocks advance by `speed` seconds per second, and every wait with a time limit ends after the same
 * time on that clock. CPU clocks stay. libfaketime leaves sem_clockwait alone, which Python uses for locks.
 */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdatomic.h>
#include <stdint.h>
#include <sys/epoll.h>
#include <sys/select.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#define SECOND 1000000000LL
/* Absolute times beyond this are since 1970, others since the start of the computer. */
#define EPOCH_S 1000000000LL

static atomic_flag held = ATOMIC_FLAG_INIT;
static double speed = 1.0;
static int64_t since_ns;  /* true monotonic time of the last change of speed */
static int64_t ahead_ns;  /* how far the clock was ahead then */

static int64_t true_ns(clockid_t clock) {
    struct timespec now;
    syscall(SYS_clock_gettime, clock, &now);
    return now.tv_sec * SECOND + now.tv_nsec;
}

static struct timespec as_timespec(int64_t ns) {
    if (ns < 0) ns = 0;
    return (struct timespec){.tv_sec = ns / SECOND, .tv_nsec = ns % SECOND};
}

static int64_t as_ns(const struct timespec *time) { return time->tv_sec * SECOND + time->tv_nsec; }

static int is_wall(clockid_t clock) {
    return clock == CLOCK_REALTIME || clock == CLOCK_MONOTONIC || clock == CLOCK_BOOTTIME ||
           clock == CLOCK_MONOTONIC_RAW || clock == CLOCK_REALTIME_COARSE || clock == CLOCK_MONOTONIC_COARSE;
}

static double take(int64_t *ahead) {
    while (atomic_flag_test_and_set_explicit(&held, memory_order_acquire)) continue;
    double now = speed;
    *ahead = ahead_ns + (int64_t)((speed - 1.0) * (double)(true_ns(CLOCK_MONOTONIC) - since_ns));
    atomic_flag_clear_explicit(&held, memory_order_release);
    return now;
}

void fast_clock_speed(double wanted) {
    while (atomic_flag_test_and_set_explicit(&held, memory_order_acquire)) continue;
    int64_t now = true_ns(CLOCK_MONOTONIC);
    ahead_ns += (int64_t)((speed - 1.0) * (double)(now - since_ns));
    since_ns = now;
    speed = wanted;
    atomic_flag_clear_explicit(&held, memory_order_release);
}

double fast_clock_true_s(void) { return (double)true_ns(CLOCK_MONOTONIC) / SECOND; }

/* The true length of a wait, ns. */
static int64_t shorter(int64_t ns) {
    int64_t ahead;
    return (int64_t)((double)ns / take(&ahead));
}

/* The true moment of an absolute one. */
static struct timespec moment(clockid_t clock, const struct timespec *wanted) {
    int64_t ahead, now = true_ns(clock);
    double factor = take(&ahead);
    return as_timespec(now + (int64_t)((double)(as_ns(wanted) - now - ahead) / factor));
}

int clock_gettime(clockid_t clock, struct timespec *found) {
    if (!is_wall(clock)) return (int)syscall(SYS_clock_gettime, clock, found);
    int64_t ahead;
    take(&ahead);
    *found = as_timespec(true_ns(clock) + ahead);
    return 0;
}

int gettimeofday(struct timeval *restrict found, void *restrict zone) {
    struct timespec now;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &now);
    *found = (struct timeval){.tv_sec = now.tv_sec, .tv_usec = now.tv_nsec / 1000};
    return 0;
}

time_t time(time_t *found) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (found) *found = now.tv_sec;
    return now.tv_sec;
}

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *wanted, struct timespec *left) {
    static int (*next)(clockid_t, int, const struct timespec *, struct timespec *);
    if (!next) next = dlsym(RTLD_NEXT, "clock_nanosleep");
    struct timespec real = flags & TIMER_ABSTIME ? moment(clock, wanted) : as_timespec(shorter(as_ns(wanted)));
    return next(clock, flags, &real, left);
}

int nanosleep(const struct timespec *wanted, struct timespec *left) {
    int error = clock_nanosleep(CLOCK_MONOTONIC, 0, wanted, left);
    if (error) errno = error;
    return error ? -1 : 0;
}

int ppoll(struct pollfd *files, nfds_t count, const struct timespec *limit, const sigset_t *signals) {
    static int (*next)(struct pollfd *, nfds_t, const struct timespec *, const sigset_t *);
    if (!next) next = dlsym(RTLD_NEXT, "ppoll");
    if (!limit) return next(files, count, limit, signals);
    struct timespec real = as_timespec(shorter(as_ns(limit)));
    return next(files, count, &real, signals);
}

int poll(struct pollfd *files, nfds_t count, int limit_ms) {
    struct timespec limit = as_timespec(limit_ms * 1000000LL);
    return ppoll(files, count, limit_ms < 0 ? NULL : &limit, NULL);
}

/* In whole milliseconds a short wait would become several times as long: wait in nanoseconds, then look. */
int epoll_wait(int file, struct epoll_event *events, int most, int limit_ms) {
    static int (*next)(int, struct epoll_event *, int, int);
    if (!next) next = dlsym(RTLD_NEXT, "epoll_wait");
    if (limit_ms > 0) {
        struct pollfd one = {.fd = file, .events = POLLIN};
        int ready = poll(&one, 1, limit_ms);
        if (ready <= 0) return ready;
        limit_ms = 0;
    }
    return next(file, events, most, limit_ms);
}

int pselect(int count, fd_set *in, fd_set *out, fd_set *odd, const struct timespec *limit, const sigset_t *signals) {
    static int (*next)(int, fd_set *, fd_set *, fd_set *, const struct timespec *, const sigset_t *);
    if (!next) next = dlsym(RTLD_NEXT, "pselect");
    if (!limit) return next(count, in, out, odd, limit, signals);
    struct timespec real = as_timespec(shorter(as_ns(limit)));
    return next(count, in, out, odd, &real, signals);
}

int select(int count, fd_set *in, fd_set *out, fd_set *odd, struct timeval *limit) {
    if (!limit) return pselect(count, in, out, odd, NULL, NULL);
    struct timespec wanted = {.tv_sec = limit->tv_sec, .tv_nsec = limit->tv_usec * 1000};
    return pselect(count, in, out, odd, &wanted, NULL);
}

int sem_clockwait(sem_t *one, clockid_t clock, const struct timespec *until) {
    static int (*next)(sem_t *, clockid_t, const struct timespec *);
    if (!next) next = dlsym(RTLD_NEXT, "sem_clockwait");
    struct timespec real = moment(clock, until);
    return next(one, clock, &real);
}

int sem_timedwait(sem_t *one, const struct timespec *until) { return sem_clockwait(one, CLOCK_REALTIME, until); }

int pthread_cond_clockwait(pthread_cond_t *one, pthread_mutex_t *lock, clockid_t clock, const struct timespec *until) {
    static int (*next)(pthread_cond_t *, pthread_mutex_t *, clockid_t, const struct timespec *);
    if (!next) next = dlsym(RTLD_NEXT, "pthread_cond_clockwait");
    struct timespec real = moment(clock, until);
    return next(one, lock, clock, &real);
}

int pthread_cond_timedwait(pthread_cond_t *one, pthread_mutex_t *lock, const struct timespec *until) {
    clockid_t clock = until->tv_sec > EPOCH_S ? CLOCK_REALTIME : CLOCK_MONOTONIC;
    return pthread_cond_clockwait(one, lock, clock, until);
}
