/* A clock that runs slower, for every process that this library is loaded into (LD_PRELOAD).
 *
 * Times that a process reads are brought nearer to a common begin, timeouts and sleeps that it asks
 * for are made longer by the same factor. So for processes that speak only with each other the
 * computer is that much faster, and nothing else has changed. Times of processors and stamps of
 * files stay as they are.
 *
 * SLOWED_TIME = factor, and the common begin by CLOCK_REALTIME and CLOCK_MONOTONIC, nanoseconds. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <linux/futex.h>
#include <poll.h>
#include <pthread.h>
#include <semaphore.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

typedef int64_t ns_t;
static const ns_t second = 1000000000;

static double factor = 1.0;
static ns_t begin_real, begin_monotonic;

/* The functions of libc. An older version of some waits by another clock: the newer one by name. */
#define OF_LIBC(result, name, ...) static result (*libc_##name)(__VA_ARGS__)
OF_LIBC(int, clock_gettime, clockid_t, struct timespec *);
OF_LIBC(int, clock_nanosleep, clockid_t, int, const struct timespec *, struct timespec *);
OF_LIBC(int, ppoll, struct pollfd *, nfds_t, const struct timespec *, const sigset_t *);
OF_LIBC(int, pselect, int, fd_set *, fd_set *, fd_set *, const struct timespec *, const sigset_t *);
OF_LIBC(int, epoll_pwait, int, struct epoll_event *, int, int, const sigset_t *);
OF_LIBC(int, sem_clockwait, sem_t *, clockid_t, const struct timespec *);
OF_LIBC(int, pthread_cond_clockwait, pthread_cond_t *, pthread_mutex_t *, clockid_t,
        const struct timespec *);
OF_LIBC(int, pthread_cond_timedwait, pthread_cond_t *, pthread_mutex_t *, const struct timespec *);
OF_LIBC(int, pthread_mutex_timedlock, pthread_mutex_t *, const struct timespec *);
OF_LIBC(int, setsockopt, int, int, int, const void *, socklen_t);
OF_LIBC(ssize_t, recvmsg, int, struct msghdr *, int);
OF_LIBC(long, syscall, long, ...);

__attribute__((constructor)) static void begin(void) {
#define FIND(name) libc_##name = (__typeof__(libc_##name))dlsym(RTLD_NEXT, #name)
    FIND(clock_gettime), FIND(clock_nanosleep), FIND(ppoll), FIND(pselect), FIND(epoll_pwait);
    FIND(sem_clockwait), FIND(pthread_cond_clockwait), FIND(pthread_mutex_timedlock);
    FIND(setsockopt), FIND(recvmsg), FIND(syscall);
    libc_pthread_cond_timedwait = (__typeof__(libc_pthread_cond_timedwait))dlvsym(
        RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
    if (!libc_pthread_cond_timedwait) FIND(pthread_cond_timedwait); /* aarch64 has one version */
    const char *told = getenv("SLOWED_TIME");
    if (!told || sscanf(told, "%lf %ld %ld", &factor, &begin_real, &begin_monotonic) != 3) {
        fprintf(stderr, "slowed_time: SLOWED_TIME is not FACTOR REAL_NS MONOTONIC_NS\n");
        _exit(2);
    }
}

static int is_slowed(clockid_t clock) {
    return clock == CLOCK_REALTIME || clock == CLOCK_MONOTONIC || clock == CLOCK_BOOTTIME ||
           clock == CLOCK_REALTIME_COARSE || clock == CLOCK_MONOTONIC_COARSE ||
           clock == CLOCK_MONOTONIC_RAW;
}

static ns_t begin_of(clockid_t clock) {
    return clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE ? begin_real : begin_monotonic;
}

static ns_t count(const struct timespec *time) { return time->tv_sec * second + time->tv_nsec; }

static struct timespec spec(ns_t time) {
    if (time < 0) time = 0;
    return (struct timespec){time / second, time % second};
}

static struct timespec slowed(clockid_t clock, const struct timespec *true_time) {
    ns_t start = begin_of(clock);
    return spec(start + (ns_t)((double)(count(true_time) - start) / factor));
}

/* The true time of one that a process has named. */
static struct timespec true_of(clockid_t clock, const struct timespec *named) {
    ns_t start = begin_of(clock);
    return spec(start + (ns_t)((double)(count(named) - start) * factor));
}

static struct timespec longer(const struct timespec *span) {
    return spec((ns_t)((double)count(span) * factor));
}

/* What is read */

int clock_gettime(clockid_t clock, struct timespec *time) {
    if (!libc_clock_gettime) FIND(clock_gettime); /* asked before the constructor */
    int failed = libc_clock_gettime(clock, time);
    if (!failed && begin_real && is_slowed(clock)) *time = slowed(clock, time);
    return failed;
}

int gettimeofday(struct timeval *restrict time, void *restrict zone) {
    (void)zone;
    struct timespec now;
    int failed = clock_gettime(CLOCK_REALTIME, &now);
    if (!failed) *time = (struct timeval){now.tv_sec, now.tv_nsec / 1000};
    return failed;
}

time_t time(time_t *into) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (into) *into = now.tv_sec;
    return now.tv_sec;
}

/* Stamps that the kernel gives to what came (SO_TIMESTAMPNS) */
ssize_t recvmsg(int socket, struct msghdr *message, int flags) {
    ssize_t n = libc_recvmsg(socket, message, flags);
    if (n < 0) return n;
    for (struct cmsghdr *each = CMSG_FIRSTHDR(message); each; each = CMSG_NXTHDR(message, each))
        if (each->cmsg_level == SOL_SOCKET && each->cmsg_type == SCM_TIMESTAMPNS) {
            struct timespec *stamp = (struct timespec *)CMSG_DATA(each);
            *stamp = slowed(CLOCK_REALTIME, stamp);
        }
    return n;
}

/* What is waited for */

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *asked,
                    struct timespec *left) {
    if (!is_slowed(clock)) return libc_clock_nanosleep(clock, flags, asked, left);
    struct timespec wanted = flags & TIMER_ABSTIME ? true_of(clock, asked) : longer(asked);
    int failed = libc_clock_nanosleep(clock, flags, &wanted, left);
    if (failed == EINTR && left && !(flags & TIMER_ABSTIME))
        *left = spec((ns_t)((double)count(left) / factor));
    return failed;
}

int nanosleep(const struct timespec *asked, struct timespec *left) {
    int failed = clock_nanosleep(CLOCK_MONOTONIC, 0, asked, left);
    if (failed) errno = failed;
    return failed ? -1 : 0;
}

int usleep(useconds_t us) {
    struct timespec asked = spec((ns_t)us * 1000);
    return nanosleep(&asked, NULL);
}

unsigned sleep(unsigned s) {
    struct timespec asked = {s, 0}, left = {0, 0};
    return nanosleep(&asked, &left) ? (unsigned)left.tv_sec + 1 : 0;
}

int ppoll(struct pollfd *files, nfds_t n, const struct timespec *timeout, const sigset_t *mask) {
    struct timespec wanted;
    if (timeout) wanted = longer(timeout);
    return libc_ppoll(files, n, timeout ? &wanted : NULL, mask);
}

int poll(struct pollfd *files, nfds_t n, int timeout_ms) {
    struct timespec timeout = spec((ns_t)timeout_ms * 1000000);
    return ppoll(files, n, timeout_ms < 0 ? NULL : &timeout, NULL);
}

int pselect(int n, fd_set *read, fd_set *write, fd_set *other, const struct timespec *timeout,
            const sigset_t *mask) {
    struct timespec wanted;
    if (timeout) wanted = longer(timeout);
    return libc_pselect(n, read, write, other, timeout ? &wanted : NULL, mask);
}

int select(int n, fd_set *read, fd_set *write, fd_set *other, struct timeval *timeout) {
    struct timespec asked;
    if (timeout) asked = (struct timespec){timeout->tv_sec, timeout->tv_usec * 1000};
    return pselect(n, read, write, other, timeout ? &asked : NULL, NULL);
}

int epoll_pwait(int epoll, struct epoll_event *events, int n, int timeout_ms,
                const sigset_t *mask) {
    if (timeout_ms > 0) timeout_ms = (int)((double)timeout_ms * factor + 0.5);
    return libc_epoll_pwait(epoll, events, n, timeout_ms, mask);
}

int epoll_wait(int epoll, struct epoll_event *events, int n, int timeout_ms) {
    return epoll_pwait(epoll, events, n, timeout_ms, NULL);
}

int sem_clockwait(sem_t *sem, clockid_t clock, const struct timespec *until) {
    struct timespec wanted = true_of(clock, until);
    return libc_sem_clockwait(sem, clock, &wanted);
}

int sem_timedwait(sem_t *sem, const struct timespec *until) {
    return sem_clockwait(sem, CLOCK_REALTIME, until);
}

int pthread_cond_clockwait(pthread_cond_t *condition, pthread_mutex_t *mutex, clockid_t clock,
                           const struct timespec *until) {
    struct timespec wanted = true_of(clock, until);
    return libc_pthread_cond_clockwait(condition, mutex, clock, &wanted);
}

/* Its clock is the condition's, which cannot be asked: the nearer of the two that it can be. */
int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex,
                           const struct timespec *until) {
    ns_t from_real = count(until) - begin_real, from_monotonic = count(until) - begin_monotonic;
    clockid_t clock = llabs(from_real) < llabs(from_monotonic) ? CLOCK_REALTIME : CLOCK_MONOTONIC;
    struct timespec wanted = true_of(clock, until);
    return libc_pthread_cond_timedwait(condition, mutex, &wanted);
}

int pthread_mutex_timedlock(pthread_mutex_t *mutex, const struct timespec *until) {
    struct timespec wanted = true_of(CLOCK_REALTIME, until);
    return libc_pthread_mutex_timedlock(mutex, &wanted);
}

int setsockopt(int socket, int level, int name, const void *value, socklen_t length) {
    struct timeval wanted;
    if (level == SOL_SOCKET && (name == SO_RCVTIMEO || name == SO_SNDTIMEO) &&
        length == sizeof wanted) {
        const struct timeval *asked = value;
        double us = ((double)asked->tv_sec * 1e6 + (double)asked->tv_usec) * factor;
        wanted = (struct timeval){(time_t)(us / 1e6), (suseconds_t)((int64_t)us % 1000000)};
        value = &wanted;
    }
    return libc_setsockopt(socket, level, name, value, length);
}

/* Rust's locks and channels wait by the system call itself. */
long syscall(long number, ...) {
    long of[6];
    va_list given;
    va_start(given, number);
    for (int i = 0; i < 6; i++) of[i] = va_arg(given, long);
    va_end(given);
    struct timespec wanted;
    if (number == SYS_futex && of[3]) {
        int operation = (int)of[1] & FUTEX_CMD_MASK;
        const struct timespec *timeout = (const struct timespec *)of[3];
        if (operation == FUTEX_WAIT) {
            wanted = longer(timeout);
            of[3] = (long)&wanted;
        } else if (operation == FUTEX_WAIT_BITSET) {
            wanted = true_of(
                (int)of[1] & FUTEX_CLOCK_REALTIME ? CLOCK_REALTIME : CLOCK_MONOTONIC, timeout);
            of[3] = (long)&wanted;
        }
    }
    return libc_syscall(number, of[0], of[1], of[2], of[3], of[4], of[5]);
}
