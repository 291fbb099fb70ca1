#!/bin/sh
# dist/companion_VERSION_ARCHITECTURE.deb, for the distribution and architecture that this runs on:
# the environment in /opt/companion is bound to the system's Python, and filled from PyPI here.
# On a Jetson or Raspberry Pi it is run there, or in a container of the same system; see
# docs/installation.md.
#
#   PYTHON=/usr/bin/python3.11   another Python of the system
set -eu
cd "$(dirname "$0")/.."

fail() { echo "build_deb.sh: $1" >&2; exit 2; }
command -v dpkg-deb >/dev/null || fail "dpkg-deb is missing: this builds on Debian and Ubuntu"
python=${PYTHON:-/usr/bin/python3}
[ -x "$python" ] || fail "$python is missing: apt install python3 python3-venv"
minor=$("$python" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')
python=/usr/bin/$minor # not python3, which is another one after an upgrade of the system
[ -x "$python" ] || fail "$python is missing: the environment is to use the system's own Python"
"$python" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 14))' ||
  fail "$minor: companion needs Python 3.10 to 3.13; say which: PYTHON=/usr/bin/python3.12"
"$python" -c 'import ensurepip' 2>/dev/null || fail "apt install python3-venv"

architecture=$(dpkg --print-architecture)
version=$(sed -n 's/^__version__ = "\(.*\)"$/\1/p' companion/__init__.py | sed 's/\.\{0,1\}\(dev\|rc\|a\|b\)/~\1/')
[ -n "$version" ] || fail "companion/__init__.py states no __version__"

root=$(mktemp -d "${TMPDIR:-/tmp}/companion-deb.XXXXXX")
trap 'rm -rf "$root"' EXIT INT TERM
chmod 755 "$root"
prefix=$root/opt/companion

"$python" -m venv "$prefix"
"$prefix/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile .
"$prefix/bin/python" -m pip uninstall --quiet --yes pip setuptools
rm -f "$prefix"/lib/python*/site-packages/companion-*.dist-info/direct_url.json
sh packaging/deb/prune.sh "$prefix"/lib/python*/site-packages
# With what is loaded late, too: nothing of that may have gone.
"$prefix/bin/python" -c 'import cv2, mavsdk, matplotlib.pyplot, numba, pyarrow.parquet, rerun
import pymavlink.DFReader, pyulog, rosbags.highlevel, scipy.stats, companion.app.cli' ||
  fail "packaging/deb/prune.sh took away too much"
# So that no start compiles them; for any processor of this architecture. Not those of the clone: -I.
"$prefix/bin/python" -I -m companion.slam.compiled.ship >/dev/null
# Where it was made is not where it will be.
grep -rlI "$prefix" "$prefix/bin" "$prefix/pyvenv.cfg" | xargs sed -i "s|$prefix|/opt/companion|g"
find "$prefix" -name __pycache__ -prune -exec rm -rf {} +
# Some packages carry files that are none of this Python, which it complains of; hence the last word.
"$python" -m compileall -q -s "$root" -p / --invalidation-mode unchecked-hash "$prefix/lib" || :

install -D -m 644 config/companion.toml "$root/etc/companion/companion.toml"
install -D -m 644 systemd/companion.service "$root/usr/lib/systemd/system/companion.service"
install -D -m 644 systemd/companion-proof.service "$root/usr/lib/systemd/system/companion-proof.service"
install -D -m 755 packaging/deb/companion-back "$root/usr/sbin/companion-back"
install -D -m 644 systemd/99-companion.rules "$root/usr/lib/udev/rules.d/99-companion.rules"
install -D -m 644 LICENSE "$root/usr/share/doc/companion/copyright"
install -D -m 644 CHANGELOG.md "$root/usr/share/doc/companion/CHANGELOG.md"
install -D -m 644 README.md "$root/usr/share/doc/companion/README.md"
(cd docs && find . -type f -exec install -D -m 644 {} "$root/usr/share/doc/companion/docs/{}" \;)
mkdir -p "$root/usr/bin" "$root/DEBIAN"
ln -s /opt/companion/bin/companion "$root/usr/bin/companion"

sed -e "s/@VERSION@/$version/" -e "s/@ARCHITECTURE@/$architecture/" -e "s/@PYTHON@/$minor/" \
  -e "s/@INSTALLED_KB@/$(du -sk "$root" | cut -f1)/" \
  packaging/deb/control >"$root/DEBIAN/control"
install -m 644 packaging/deb/conffiles "$root/DEBIAN/conffiles"
install -m 755 packaging/deb/preinst packaging/deb/postinst packaging/deb/prerm packaging/deb/postrm "$root/DEBIAN"

mkdir -p dist
deb=dist/companion_${version}_$architecture.deb
# A minute here for 6 % less to carry; unpacking, on a small computer, takes no longer by it.
dpkg-deb --root-owner-group -Zzstd -z12 --build "$root" "$deb" >/dev/null
echo "$deb: $(du -h "$deb" | cut -f1), needs $minor"
