#!/bin/sh
# What the tests need besides Python packages: a browser, OpenGL without a screen, a proxy.
# Installs them where that is possible without asking; says in one sentence what is missing otherwise.
set -u
missing=""
command -v chromium >/dev/null 2>&1 || command -v chromium-browser >/dev/null 2>&1 || missing="chromium"
command -v nginx >/dev/null 2>&1 || [ -x /usr/sbin/nginx ] || missing="$missing nginx-light"
if [ "$(uname)" = Linux ]; then
  for entry in libEGL.so.1:libegl1 libEGL_mesa.so.0:libegl-mesa0 libGLESv2.so.2:libgles2 libOSMesa.so.8:libosmesa6; do
    "${PYTHON:-.venv/bin/python}" -c "import ctypes; ctypes.CDLL('${entry%%:*}')" 2>/dev/null ||
      missing="$missing ${entry##*:} libgl1-mesa-dri"
  done
fi
[ -z "$missing" ] && exit 0
if command -v apt-get >/dev/null 2>&1; then
  as_root=""
  [ "$(id -u)" = 0 ] || as_root="sudo -n"
  # shellcheck disable=SC2086
  if $as_root apt-get update -q >/dev/null 2>&1 &&
    DEBIAN_FRONTEND=noninteractive $as_root apt-get install -y -q --no-install-recommends $missing >/dev/null 2>&1; then
    exit 0
  fi
fi
echo "some tests will be skipped; to run them install:$( [ -n "$missing" ] && echo " $missing")" >&2
exit 0
