/* A library to preload: a file system on which all locks fail with $LOCKERR (ENOLCK if unset). */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <dlfcn.h>
#include <stdarg.h>
#include <stdlib.h>
static int refuse(void) { const char *e = getenv("LOCKERR"); errno = e ? atoi(e) : 37; return -1; }
int flock(int fd, int op) { return refuse(); }
int lockf(int fd, int c, off_t l) { return refuse(); }
static int all(const char *name, int fd, int cmd, void *arg) {
  if ((cmd >= F_GETLK && cmd <= F_SETLKW) || cmd == F_OFD_SETLK || cmd == F_OFD_SETLKW) return refuse();
  return ((int (*)(int, int, ...))dlsym(RTLD_NEXT, name))(fd, cmd, arg);
}
#define WRAP(NAME) int NAME(int fd, int cmd, ...) \
  { va_list a; va_start(a, cmd); void *p = va_arg(a, void *); va_end(a); return all(#NAME, fd, cmd, p); }
WRAP(fcntl)
WRAP(fcntl64)
