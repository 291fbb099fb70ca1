/* A driver that fails: loaded before OpenCL (LD_PRELOAD), it spoils what one device is told to do.
 *
 *   FAULT         build, wrong, abort, hang or lost
 *   FAULT_DEVICE  the device's name
 *   FAULT_AFTER   so many kernels of it are run first
 *   FAULT_WHEN    a file; before it is there nothing is spoilt ("": at once)
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <link.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

typedef int32_t cl_int;
typedef uint32_t cl_uint;
typedef void *handle; /* of devices, queues, programs, kernels, events */

enum { DEVICE_NAME = 0x102B, QUEUE_DEVICE = 0x1091, PROGRAM_DEVICES = 0x1163 };
enum { OUT_OF_RESOURCES = -5, BUILD_FAILURE = -11 };

static int find(struct dl_phdr_info *info, size_t size, void *out) {
  (void)size;
  if (info->dlpi_name && strstr(info->dlpi_name, "libOpenCL")) {
    *(const char **)out = info->dlpi_name;
    return 1;
  }
  return 0;
}

static void *real(const char *name) {
  const char *path = NULL;
  dl_iterate_phdr(find, &path);
  void *library = path ? dlopen(path, RTLD_LAZY | RTLD_NOLOAD) : NULL;
  void *found = library ? dlsym(library, name) : NULL;
  if (!found) abort();
  return found;
}

static int is_fault(const char *name) {
  const char *fault = getenv("FAULT");
  return fault && !strcmp(fault, name);
}

static int concerns(handle device) {
  const char *wanted = getenv("FAULT_DEVICE"), *file = getenv("FAULT_WHEN");
  char name[512] = "";
  cl_int (*info)(handle, cl_uint, size_t, void *, size_t *) = real("clGetDeviceInfo");
  info(device, DEVICE_NAME, sizeof name, name, NULL);
  return wanted && !strcmp(name, wanted) && (!file || !*file || !access(file, F_OK));
}

cl_int clBuildProgram(handle program, cl_uint n, const handle *devices, const char *options,
                      void *notify, void *data) {
  cl_int (*build)(handle, cl_uint, const handle *, const char *, void *, void *) =
      real("clBuildProgram");
  cl_int (*info)(handle, cl_uint, size_t, void *, size_t *) = real("clGetProgramInfo");
  handle of[16] = {NULL};
  info(program, PROGRAM_DEVICES, sizeof of, of, NULL);
  if (is_fault("build") && of[0] && concerns(of[0])) return BUILD_FAILURE;
  return build(program, n, devices, options, notify, data);
}

cl_int clEnqueueNDRangeKernel(handle queue, handle kernel, cl_uint dims, const size_t *offset,
                              const size_t *size, const size_t *group, cl_uint n_wait,
                              const handle *wait, handle *event) {
  static long n_run = 0;
  cl_int (*run)(handle, handle, cl_uint, const size_t *, const size_t *, const size_t *, cl_uint,
                const handle *, handle *) = real("clEnqueueNDRangeKernel");
  cl_int (*info)(handle, cl_uint, size_t, void *, size_t *) = real("clGetCommandQueueInfo");
  const char *after = getenv("FAULT_AFTER");
  handle device = NULL;
  info(queue, QUEUE_DEVICE, sizeof device, &device, NULL);
  if (concerns(device) && n_run++ >= (after ? atol(after) : 0)) {
    if (is_fault("abort")) abort();
    if (is_fault("lost")) return OUT_OF_RESOURCES;
    if (is_fault("hang"))
      for (;;) pause();
    if (is_fault("wrong")) size = group; /* one group of work items, of all that there are */
  }
  return run(queue, kernel, dims, offset, size, group, n_wait, wait, event);
}
