#!/bin/sh
# prune.sh SITE_PACKAGES: takes away what companion never loads: tests and headers of libraries,
# Arrow's network service, and dialects of MAVLink that it does not speak.
set -eu
cd "$1"

find . -depth -type d \( -name tests -o -name test \) -exec rm -rf {} +
rm -rf pyarrow/include pyarrow/src
rm -f pyarrow/libarrow_flight* pyarrow/libarrow_python_flight* pyarrow/_flight* pyarrow/*_tests.*
# pymavlink's readers of logs load "all" of the first version, its own ending
find pymavlink/dialects -type f ! -name __init__.py ! -name all.py ! -name ardupilotmega.py -delete
