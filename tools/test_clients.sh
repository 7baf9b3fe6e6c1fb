#!/bin/sh
# Installs the Debian programs that open exports and pages in tests, if this user may; otherwise those tests are skipped.
missing=""
command -v compare_octrees >/dev/null 2>&1 || missing="$missing octomap-tools"
/usr/bin/python3 -c 'import pyopenvdb' >/dev/null 2>&1 || /usr/bin/python3 -c 'import openvdb' >/dev/null 2>&1 ||
    missing="$missing python3-openvdb"
command -v chromium >/dev/null 2>&1 || missing="$missing chromium"
[ -z "$missing" ] && exit 0
command -v apt-get >/dev/null 2>&1 || exit 0
if [ "$(id -u)" = 0 ]; then as_root=""; else as_root="sudo -n"; fi
{ $as_root apt-get update -qq &&
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing; } >/dev/null 2>&1 ||
    echo "Tests with$missing will be skipped: sudo apt-get install$missing" >&2
exit 0
