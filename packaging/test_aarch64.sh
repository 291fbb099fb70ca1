#!/bin/sh
# Tests on aarch64, emulated: packages of a Debian 12 for arm64 and wheels for it, unpacked here, in which
# the tests that compute, encode and pass messages run under qemu-user. As root, on Debian or Ubuntu:
#
#   apt install debootstrap qemu-user-static python3-pip
#   sh packaging/test_aarch64.sh [--bind PATH]... [--mirror URL] [FOLDER] [-- ARGUMENTS OF PYTEST]
#
#   FOLDER           where it lies (/var/tmp/companion-aarch64): 3 GB, made where there is none, used
#                    again later; FOLDER/tests.log is what pytest said, FOLDER/verdict its last line
#   --bind PATH      seen at the same place inside, read-only: certificates and the like
#   --mirror URL     of Debian packages
#   -- ARGUMENTS     tests to run instead of those below, or options beside them: -- --durations=20
#   PYTHON=python3   whose pip fetches the wheels, as it is configured
#
# Variables of the environment are passed on. Mounts and the registration of the emulator are made
# for this run only and end with it, as does every process inside. Nothing is configured by Debian's
# own scripts, which take long under the emulator.
# QEMU_CPU is the processor of a Raspberry Pi 4 unless it is set.
set -eu

# Rooms whose results hang on arithmetic, memory or bytes.
tests='
tests/unit/geometry tests/unit/runtime tests/unit/topics tests/unit/timing tests/unit/estimation
tests/unit/drivers/mavlink tests/unit/drivers/recording tests/unit/drivers/telemetry
tests/unit/slam tests/unit/dense'
# What cannot pass here, and why.
left_out='
tests/unit/runtime/test_stage_times.py::test_hours_of_flight_cost_no_more_than_minutes measures processor time
tests/unit/slam/test_kernel_cache.py looks for compiled loops where NUMBA_CACHE_DIR does not put them
'

fail() { echo "test_aarch64.sh: $1" >&2; exit 2; }
says() { echo "aarch64: $*"; }
inside() {
  env -u LD_LIBRARY_PATH -u LD_PRELOAD -u PYTHONDONTWRITEBYTECODE -u PYTHONHOME -u PYTHONPATH -u TMPDIR -u VIRTUAL_ENV \
    HOME=/root PATH=/venv/bin:/usr/sbin:/usr/bin:/sbin:/bin LC_ALL=C.UTF-8 \
    NUMBA_CACHE_DIR=/var/cache/numba PYTHONPYCACHEPREFIX=/var/cache/python QEMU_CPU="$QEMU_CPU" chroot "$system" "$@"
}

if [ "${1:-}" != --in-namespace ]; then
  [ "$(id -u)" -eq 0 ] || fail "this mounts and changes root: run it as root"
  for command in debootstrap qemu-aarch64-static; do
    command -v $command >/dev/null || fail "$command is missing: apt install debootstrap qemu-user-static"
  done
  exec nice -n 19 chrt --idle 0 \
    unshare --mount --propagation private --pid --fork --kill-child sh "$0" --in-namespace "$@"
fi
shift

project=$(cd "$(dirname "$0")/.." && pwd)
folder=/var/tmp/companion-aarch64 mirror=http://deb.debian.org/debian binds=
python=${PYTHON:-python3} QEMU_CPU=${QEMU_CPU:-cortex-a72}
while [ $# -gt 0 ]; do
  case $1 in
    --bind) binds="$binds ${2:?--bind needs a path}"; shift 2 ;;
    --mirror) mirror=${2:?--mirror needs an address}; shift 2 ;;
    --) shift; break ;;
    -*) fail "unknown option $1" ;;
    *) folder=$1; shift ;;
  esac
done
mkdir -p "$folder"
folder=$(cd "$folder" && pwd)
system=$folder/system
for path in $binds; do [ -e "$path" ] || fail "--bind $path: there is nothing"; done

# The registration ends with the mount that it is made by; one of this computer's own is used as it is.
register_emulator() {
  binfmt=/proc/sys/fs/binfmt_misc
  [ -e $binfmt/register ] || mount -t binfmt_misc binfmt_misc $binfmt || fail "no binfmt_misc in this kernel"
  for entry in $binfmt/qemu-aarch64*; do [ ! -e "$entry" ] || return 0; done
  cat /usr/lib/binfmt.d/qemu-aarch64*.conf >$binfmt/register || fail "the emulator could not be registered"
}

# A mark says that it is whole.
unpack_system() {
  [ ! -e "$folder/unpacked" ] || return 0
  says "packages of Debian 12 for arm64 into $system"
  rm -rf "$system"
  debootstrap --arch=arm64 --variant=minbase --foreign --include=ca-certificates,pocl-opencl-icd,python3-venv \
    bookworm "$system" "$mirror" >"$folder/system.log" || fail "debootstrap: $(tail -1 "$folder/system.log")"
  for package in "$system"/var/cache/apt/archives/*.deb; do
    dpkg-deb --fsys-tarfile "$package" | tar -x -C "$system" --keep-directory-symlink
  done
  inside /sbin/ldconfig
  inside python3 -m venv --without-pip /venv
  touch "$folder/unpacked"
}

# By this computer's pip, which is many times as fast; pip check has the last word on what it chose.
unpack_wheels() {
  cmp -s "$project/pyproject.toml" "$folder/installed.toml" && return
  says "wheels for aarch64 of what the project and its tests need"
  needs=$folder/needs.txt site=$system/venv/lib/python3.11/site-packages
  inside python -c 'import sys, tomllib
project = tomllib.load(sys.stdin.buffer)["project"]
print(*project["dependencies"], *project["optional-dependencies"]["dev"], sep="\n")' \
    <"$project/pyproject.toml" >"$needs"
  platforms=$(seq -f '--platform manylinux_2_%.0f_aarch64' 17 36)
  rm -rf "$site"
  # shellcheck disable=SC2086 # many options
  "$python" -m pip install --quiet --no-compile --only-binary :all: --python-version 3.11 $platforms \
    --target "$site" --requirement "$needs" pip || fail "pip did not find wheels of everything"
  echo /companion >"$site/companion.pth"
  printf '#!/bin/sh\nexec /venv/bin/python -m companion "$@"\n' >"$system/venv/bin/companion"
  chmod 755 "$system/venv/bin/companion"
  compile_wheels
  inside python -m pip check || fail "what pip chose here is not what is needed there"
  cp "$project/pyproject.toml" "$folder/installed.toml"
}

# Python's bytecode hangs on no processor: that of the same version here makes it many times as fast.
compile_wheels() {
  command -v python3.11 >/dev/null || return 0
  rm -rf "$folder/bytecode" "$system/var/cache/python"
  PYTHONPYCACHEPREFIX=$folder/bytecode python3.11 -m compileall -q -s "$system" -p / "$site" >"$folder/compiled.log" ||
    says "some packages carry files that are none of Python 3.11: $folder/compiled.log"
  mkdir -p "$system/var/cache/python"
  mv "$folder/bytecode$system/venv" "$system/var/cache/python/venv"
}

mount_within() {
  for place in proc sys dev; do # debootstrap leaves links to this computer's where it sees a container
    [ ! -L "$system/$place" ] || rm "$system/$place"
    mkdir -p "$system/$place"
  done
  mount -t proc proc "$system/proc"
  mount --rbind /sys "$system/sys" # without it PoCL ends the program
  mount --rbind /dev "$system/dev"
  mount -t tmpfs -o mode=1777 tmpfs "$system/dev/shm"
  mkdir -p "$system/var/cache/numba"
  mount_read_only "$project" "$system/companion"
  for path in $binds; do mount_read_only "$path" "$system$path"; done
}

mount_read_only() {
  if [ -d "$1" ]; then mkdir -p "$2"; else mkdir -p "${2%/*}" && touch "$2"; fi
  mount --bind "$1" "$2"
  mount -o remount,bind,ro "$2"
}

# The verdict is pytest's last line, after what failed, skipped itself or was left out, with reasons.
run_tests() {
  if [ $# -eq 0 ] || [ "${1#-}" != "$1" ]; then
    # shellcheck disable=SC2086 # one word each
    set -- $tests "$@"
  fi
  deselected=$(echo "$left_out" | sed -n 's/^\(tests[^ ]*\) .*/--deselect=\1/p')
  says "$(date -u +%F), $(inside uname -m), $(inside python -V), $QEMU_CPU"
  status=0
  # shellcheck disable=SC2086 # one word each
  inside sh -c 'cd /companion && exec python -m pytest -p no:cacheprovider -m "not real_time" -o timeout=3600 "$@"' \
    sh $deselected "$@" >"$folder/tests.log" 2>&1 || status=$?
  grep -E '^(FAILED|ERROR|SKIPPED) ' "$folder/tests.log" || :
  says "left out:$left_out"
  tail -1 "$folder/tests.log" | tee "$folder/verdict"
  return $status
}

register_emulator
unpack_system
unpack_wheels
mount_within
run_tests "$@"
