/* File operations of a process, native libraries' too, counted; the n-th kills the process or fails.

   Loaded with LD_PRELOAD. Does nothing until `faults_arm`. Operations are those that change what is below a folder:
   open to write, write, truncate, rename, link, mkdir, unlink, rmdir, fsync. A map of a file (mmap) is not seen. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { COUNT, KILL, TEAR, FAIL_ONCE, FAIL_ON };

static char folder[PATH_MAX];
static size_t folder_length;
static int mode, error_number, armed;
static long target;
static atomic_long seen;

void faults_arm(const char *below, int how, long nth, int number) {
  strncpy(folder, below, sizeof folder - 1);
  folder_length = strlen(folder);
  mode = how, target = nth, error_number = number;
  atomic_store(&seen, 0);
  armed = 1;
}

void faults_disarm(void) { armed = 0; }

long faults_seen(void) { return atomic_load(&seen); }

static int is_below(const char *path) {
  return !strncmp(path, folder, folder_length) && (path[folder_length] == '/' || !path[folder_length]);
}

static int place(int at, const char *path, char *full) {
  if (!path) return 0;
  if (path[0] == '/') return snprintf(full, PATH_MAX, "%s", path) > 0;
  char link[64], base[PATH_MAX];
  if (at == AT_FDCWD) {
    if (!getcwd(base, sizeof base)) return 0;
  } else {
    snprintf(link, sizeof link, "/proc/self/fd/%d", at);
    ssize_t n = readlink(link, base, sizeof base - 1);
    if (n < 0) return 0;
    base[n] = 0;
  }
  return snprintf(full, PATH_MAX, "%.2000s/%.2000s", base, path) > 0;
}

/* 0: go on; 1: fail with errno set; 2: write half, then die. */
static int strike(void) {
  long k = atomic_fetch_add(&seen, 1) + 1;
  if (mode == COUNT || k < target || (k > target && mode != FAIL_ON)) return 0;
  if (mode == TEAR) return 2;
  if (mode == KILL) kill(0, SIGKILL);
  errno = error_number;
  return 1;
}

static int on_path(int at, const char *path) {
  char full[PATH_MAX];
  return armed && place(at, path, full) && is_below(full) ? strike() : 0;
}

static int on_file(int handle) {
  if (!armed) return 0;
  char link[64], full[PATH_MAX];
  snprintf(link, sizeof link, "/proc/self/fd/%d", handle);
  ssize_t n = readlink(link, full, sizeof full - 1);
  if (n < 0) return 0;
  full[n] = 0;
  return is_below(full) ? strike() : 0;
}

#define REAL(name) static __typeof__(name) *real; if (!real) real = dlsym(RTLD_NEXT, #name)
#define DIE() kill(0, SIGKILL)
#define PATH_OPERATION(name, parameters, at, path, arguments) \
  int name parameters { REAL(name); int s = on_path(at, path); if (s == 2) DIE(); return s ? -1 : real arguments; }
#define FILE_OPERATION(name, parameters, arguments) \
  int name parameters { REAL(name); int s = on_file(handle); if (s == 2) DIE(); return s ? -1 : real arguments; }

static int writes(int flags) { return (flags & O_ACCMODE) != O_RDONLY || flags & (O_CREAT | O_TRUNC); }

#define OPEN(name, first_declared, first, at) \
  int name(first_declared const char *path, int flags, ...) { \
    REAL(name); \
    va_list rest; va_start(rest, flags); int bits = va_arg(rest, int); va_end(rest); \
    int s = writes(flags) ? on_path(at, path) : 0; \
    if (s == 2) DIE(); \
    return s ? -1 : real(first path, flags, bits); \
  }
#define COMMA ,
OPEN(open, , , AT_FDCWD)
OPEN(open64, , , AT_FDCWD)
OPEN(openat, int at COMMA, at COMMA, at)
OPEN(openat64, int at COMMA, at COMMA, at)

#define WRITE(name, parameters, whole, half) \
  ssize_t name parameters { \
    REAL(name); int s = on_file(handle); \
    if (s == 2) { (void)!half; DIE(); } \
    return s ? -1 : whole; \
  }
WRITE(write, (int handle, const void *data, size_t size), real(handle, data, size), real(handle, data, size / 2))
WRITE(pwrite, (int handle, const void *data, size_t size, off_t at), real(handle, data, size, at), real(handle, data, size / 2, at))
WRITE(pwrite64, (int handle, const void *data, size_t size, off64_t at), real(handle, data, size, at), real(handle, data, size / 2, at))
WRITE(writev, (int handle, const struct iovec *parts, int count), real(handle, parts, count), real(handle, parts, count / 2))
WRITE(sendfile, (int handle, int from, off_t *at, size_t size), real(handle, from, at, size), real(handle, from, at, size / 2))
WRITE(sendfile64, (int handle, int from, off64_t *at, size_t size), real(handle, from, at, size), real(handle, from, at, size / 2))

FILE_OPERATION(fsync, (int handle), (handle))
FILE_OPERATION(fdatasync, (int handle), (handle))
FILE_OPERATION(ftruncate, (int handle, off_t size), (handle, size))
FILE_OPERATION(ftruncate64, (int handle, off64_t size), (handle, size))
PATH_OPERATION(truncate, (const char *path, off_t size), AT_FDCWD, path, (path, size))
PATH_OPERATION(rename, (const char *from, const char *to), AT_FDCWD, to, (from, to))
PATH_OPERATION(renameat, (int a, const char *from, int b, const char *to), b, to, (a, from, b, to))
PATH_OPERATION(link, (const char *from, const char *to), AT_FDCWD, to, (from, to))
PATH_OPERATION(linkat, (int a, const char *from, int b, const char *to, int flags), b, to, (a, from, b, to, flags))
PATH_OPERATION(symlink, (const char *from, const char *to), AT_FDCWD, to, (from, to))
PATH_OPERATION(mkdir, (const char *path, mode_t bits), AT_FDCWD, path, (path, bits))
PATH_OPERATION(mkdirat, (int at, const char *path, mode_t bits), at, path, (at, path, bits))
PATH_OPERATION(unlink, (const char *path), AT_FDCWD, path, (path))
PATH_OPERATION(unlinkat, (int at, const char *path, int flags), at, path, (at, path, flags))
PATH_OPERATION(rmdir, (const char *path), AT_FDCWD, path, (path))
