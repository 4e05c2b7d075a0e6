/* Loaded before the C library (LD_PRELOAD): one system call on files below a folder fails once, or is only counted.

   arm(name, nth, error, folder): the nth call of `name` (0 = none) on a file below `folder` returns -1 with errno `error`.
   seen(): calls of `name` on files below the folder since then. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

static char watched[32], folder[PATH_MAX];
static int nth, error_number;
static atomic_int count;

void arm(const char *name, int which, int error, const char *below) {
    snprintf(watched, sizeof watched, "%s", name);
    snprintf(folder, sizeof folder, "%s", below);
    nth = which, error_number = error;
    atomic_store(&count, 0);
}

int seen(void) { return atomic_load(&count); }

static int fails_below(const char *name, const char *path) {
    if (!path || strcmp(name, watched) || strncmp(path, folder, strlen(folder))) return 0;
    if (atomic_fetch_add(&count, 1) + 1 != nth) return 0;
    errno = error_number;
    return 1;
}

static const char *path_of(int file, char *found) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    int before = errno;
    ssize_t length = readlink(link, found, PATH_MAX - 1);
    errno = before;
    if (length < 0) return NULL;
    found[length] = 0;
    return found;
}

static int fails_on(const char *name, int file) {
    char found[PATH_MAX];
    return *watched && !strcmp(name, watched) && fails_below(name, path_of(file, found));
}

/* Names that are relative to an open folder. */
static int fails_at(const char *name, int at, const char *path) {
    char found[2 * PATH_MAX];
    if (!*watched || strcmp(name, watched)) return 0;
    if (path && *path != '/' && at != AT_FDCWD && path_of(at, found)) {
        strcat(found, "/");
        strncat(found, path, PATH_MAX - 2);
        return fails_below(name, found);
    }
    return fails_below(name, path);
}

#define REAL(name) __typeof__(&name) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)
#define MODE mode_t mode = 0; if (flags & (O_CREAT | O_TMPFILE)) { va_list rest; va_start(rest, flags); mode = va_arg(rest, mode_t); va_end(rest); }

int open(const char *path, int flags, ...) { MODE REAL(open); return fails_below("open", path) ? -1 : real(path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE REAL(open64); return fails_below("open", path) ? -1 : real(path, flags, mode); }
int openat(int at, const char *path, int flags, ...) { MODE REAL(openat); return fails_at("open", at, path) ? -1 : real(at, path, flags, mode); }
int openat64(int at, const char *path, int flags, ...) { MODE REAL(openat64); return fails_at("open", at, path) ? -1 : real(at, path, flags, mode); }
ssize_t write(int file, const void *bytes, size_t size) { REAL(write); return fails_on("write", file) ? -1 : real(file, bytes, size); }
ssize_t pwrite64(int file, const void *bytes, size_t size, off64_t at) { REAL(pwrite64); return fails_on("write", file) ? -1 : real(file, bytes, size, at); }
ssize_t read(int file, void *bytes, size_t size) { REAL(read); return fails_on("read", file) ? -1 : real(file, bytes, size); }
ssize_t pread64(int file, void *bytes, size_t size, off64_t at) { REAL(pread64); return fails_on("read", file) ? -1 : real(file, bytes, size, at); }
int fsync(int file) { REAL(fsync); return fails_on("fsync", file) ? -1 : real(file); }
int flock(int file, int operation) { REAL(flock); return fails_on("flock", file) ? -1 : real(file, operation); }
int rename(const char *from, const char *to) { REAL(rename); return fails_below("rename", from) ? -1 : real(from, to); }
int unlink(const char *path) { REAL(unlink); return fails_below("unlink", path) ? -1 : real(path); }
int unlinkat(int at, const char *path, int flags) { REAL(unlinkat); return fails_at("unlink", at, path) ? -1 : real(at, path, flags); }
int rmdir(const char *path) { REAL(rmdir); return fails_below("unlink", path) ? -1 : real(path); }
int mkdir(const char *path, mode_t mode) { REAL(mkdir); return fails_below("mkdir", path) ? -1 : real(path, mode); }
int chmod(const char *path, mode_t mode) { REAL(chmod); return fails_below("chmod", path) ? -1 : real(path, mode); }
int fstatat64(int at, const char *path, struct stat64 *found, int flags) { REAL(fstatat64); return fails_at("stat", at, path) ? -1 : real(at, path, found, flags); }
int stat64(const char *path, struct stat64 *found) { REAL(stat64); return fails_below("stat", path) ? -1 : real(path, found); }
int lstat64(const char *path, struct stat64 *found) { REAL(lstat64); return fails_below("stat", path) ? -1 : real(path, found); }
