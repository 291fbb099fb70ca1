#!/bin/sh
# An OpenCL device that works, for an environment that companion is installed in: sh opencl.sh VENV
#
# Nothing is installed where there is one. Else the first of these that gives a device which computes
# right: the distribution's PoCL, where packages may be installed (on a processor newer than itself it
# compiles for the nearest that it knows); then, on x86-64 of any make, Intel's runtime for processors
# from PyPI, which goes into the environment and needs no rights, no compiler and no linker.
# Exit status 1 where neither does, with what to type.
set -eu

venv=${1:?usage: sh opencl.sh VENV}
runtime='intel-opencl-rt>=2026.1 intel-cmplr-lib-rt>=2026.1' # the second brings its libimf and libsvml

says() { echo "OpenCL: $*"; }
works() { "$venv/bin/companion" devices --opencl >/dev/null 2>&1; }

as_root() {
  if [ "$(id -u)" -eq 0 ]; then "$@"; else sudo -n "$@"; fi
}

may_install_packages() {
  command -v apt-get >/dev/null || return 1
  [ "$(id -u)" -eq 0 ] || { command -v sudo >/dev/null && sudo -n true 2>/dev/null; }
}

install_pocl() {
  as_root apt-get update -qq &&
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -qq -y -o DPkg::Lock::Timeout=300 --no-install-recommends pocl-opencl-icd
}

install_intel() {
  # shellcheck disable=SC2086 # two requirements
  "$venv/bin/python" -m pip install --quiet --disable-pip-version-check $runtime || return 1
  # pyopencl's loader reads drivers' names in /etc/OpenCL/vendors and beside itself. The wheel's own
  # file names the library by a path of where it was made.
  library=$(cd "$venv" && pwd)/lib/libintelocl.so
  [ -f "$library" ] || return 1
  for beside in "$venv"/lib/python3.*/site-packages/pyopencl/.libs; do
    echo "$library" >"$beside/intel.icd" || return 1
  done
}

works && exit 0

if may_install_packages; then
  says "no device works here; installing pocl-opencl-icd, which runs the kernels on the processor"
  said=$(install_pocl 2>&1) || says "pocl-opencl-icd could not be installed: $(echo "$said" | tail -1)"
  works && exit 0
fi
if [ "$(uname -m)" = x86_64 ]; then
  says "no device works here, and no package of the system helps or may be installed;" \
    "installing Intel's runtime for processors from PyPI (270 MB, its own licence) into $venv"
  install_intel || says "Intel's runtime could not be installed"
  works && exit 0
fi

"$venv/bin/companion" devices --opencl >&2 || :
says "no device works here. Type: sudo apt install pocl-opencl-icd" >&2
exit 1
