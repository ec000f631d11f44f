#!/usr/bin/env bash
# A disk that is full, a folder that may only be read, and input that vanishes while it is read: one
# error each, nothing half-written, and the work goes on where it was. Needs the right to mount (root);
# says so and ends where it has not.
#
#   cargo build --release && tests/full-disk.sh target/release/shearq
set -uo pipefail
shearq=$(realpath "${1:?the shearq binary}")
work=$(mktemp -d)
disk=$work/disk
mkdir "$disk"
if ! mount -t tmpfs -o size=300k tmpfs "$disk" 2>/dev/null; then
  echo "skipped: no right to mount a file system"
  exit 0
fi
trap 'umount -l "$disk" 2>/dev/null; rm -rf "$work"' EXIT
failed=0
bad() { echo "FAILED: $*"; failed=1; }
# One line of error, of the text given, and no panic.
expect_error() {
  local wanted=$1; shift
  local message
  message=$("$@" 2>&1 >/dev/null) && bad "$* succeeded"
  echo "  $message"
  [ "$(grep -c '^error: ' <<<"$message")" = 1 ] || bad "not one error"
  grep -q "$wanted" <<<"$message" || bad "expected: $wanted"
  grep -q panicked <<<"$message" && bad "a panic"
}
run() { "$shearq" run --simulate --fixed-psf one --sets 2 --images 6 --grid 24 --submission 23/raw/star --threads 2 "$@"; }
run --out "$work/whole" >/dev/null 2>&1 || bad "undisturbed run"

echo "a full disk:"
expect_error "No space left on device" run --out "$disk/out"
ls -A "$disk"/out/set02 | grep -q '\.part$' && bad "a half-written file"
kept=$(ls "$disk"/out/set02 | grep -c catalogue)
[ "$kept" -gt 0 ] || bad "nothing kept"
mount -o remount,size=8m "$disk"
run --out "$disk/out" 2>&1 >/dev/null | grep -q "$kept there already" || bad "did not go on"
diff -r "$work/whole" "$disk/out" || bad "not the same bytes"

echo "a folder that may only be read:"
mount -o remount,ro "$disk"
expect_error "Read-only file system" run --out "$disk/other"
mount -o remount,rw "$disk"

echo "input that vanishes:"
"$shearq" simulate --fixed-psf one --sets 2 --images 6 --grid 24 --out "$work/data" 2>/dev/null || bad "simulate"
mv "$work/data/set02/psf-004.fits" "$work/psf"
expect_error "psf-004.fits" "$shearq" measure --submission 23/raw/star --data "$work/data" --out "$work/measured" --threads 1
[ "$(ls "$work"/measured/set02 | grep -c catalogue)" = 3 ] || bad "three images should be there"
mv "$work/psf" "$work/data/set02/psf-004.fits"
"$shearq" measure --submission 23/raw/star --data "$work/data" --out "$work/measured" 2>/dev/null || bad "resume"
diff -r -x run.json -x '*.csv' "$work/whole" "$work/measured" >/dev/null || bad "not the same catalogues"
[ $failed = 0 ] && echo "all as expected"
exit $failed
