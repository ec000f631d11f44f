#!/usr/bin/env bash
# Runs the array job of docs/large-jobs.md on a Slurm cluster of one node, set up for this in a temporary
# folder, and compares what it leaves with what one process leaves.
#
#   tests/slurm.sh SHEARQ [--install]
#
# SHEARQ is the binary. Needs root, slurmctld, slurmd, Slurm's clients and munge; --install installs
# them on Debian. Says why and exits with 0 where it cannot run. Not part of `cargo test`.
set -euo pipefail

skip() { echo "skipped: $*"; exit 0; }

project=$(cd "$(dirname "$0")/.." && pwd)
shearq=$(realpath "${1:?usage: tests/slurm.sh SHEARQ [--install]}")
[ "$(id -u)" = 0 ] || skip "slurmd needs root"
if [ "${2-}" = --install ]; then
  command -v apt-get >/dev/null || skip "--install needs Debian's apt-get"
  apt-get update -q && apt-get install -q -y --no-install-recommends slurmctld slurmd slurm-client munge \
    || skip "the packages cannot be installed"
fi
for program in slurmctld slurmd sbatch scontrol squeue munged mungekey; do
  command -v "$program" >/dev/null || PATH=$PATH:/usr/sbin command -v "$program" >/dev/null \
    || skip "there is no $program; --install installs it on Debian"
done
PATH=$PATH:/usr/sbin

place=$(mktemp -d)
daemons=()
finish() {
  status=$?
  for pid in "${daemons[@]}"; do kill "$pid" 2>/dev/null || true; done
  wait
  if [ $status != 0 ]; then tail -n 20 "$place"/*.log "$place"/work/*.log 2>/dev/null || true; fi
  rm -rf "$place"
}
trap finish EXIT

# A cluster of its own: its own key, ports and folders, and no cgroups, which containers often lack.
node=$(hostname -s)
mkdir -p "$place"/{munge,state,spool,work}
chmod 755 "$place"
chmod 700 "$place/munge"
mungekey --create --keyfile="$place/munge/key"
munged --foreground --force --socket="$place/munge.socket" --key-file="$place/munge/key" \
  --pid-file="$place/munge/pid" --seed-file="$place/munge/seed" >"$place/munged.log" 2>&1 &
daemons+=($!)
cat >"$place/slurm.conf" <<CONF
ClusterName=shearq
SlurmctldHost=$node(127.0.0.1)
SlurmctldPort=16817
SlurmdPort=16818
AuthType=auth/munge
AuthInfo=socket=$place/munge.socket
CredType=cred/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation=$place/state
SlurmdSpoolDir=$place/spool
SlurmctldPidFile=$place/slurmctld.pid
SlurmdPidFile=$place/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
NodeName=$node NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=1000 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
# Slurm before 23.02 does not know `disabled`, but does without cgroups under the older of its plugins.
version=$(slurmctld -V | cut -d' ' -f2)
case $version in
  2[0-2].*) echo "CgroupPlugin=cgroup/v1" ;;
  *) echo "CgroupPlugin=disabled" ;;
esac >"$place/cgroup.conf"
export SLURM_CONF=$place/slurm.conf
slurmctld -D -c -f "$SLURM_CONF" >"$place/slurmctld.log" 2>&1 &
daemons+=($!)
slurmd -D -f "$SLURM_CONF" >"$place/slurmd.log" 2>&1 &
daemons+=($!)
for _ in $(seq 60); do
  state=$(scontrol show node "$node" 2>/dev/null | grep -o 'State=[A-Z]*' || true)
  [ "$state" = State=IDLE ] && break
  sleep 1
done
[ "$state" = State=IDLE ] || { echo "the node does not come up: $state"; exit 1; }
echo "Slurm $version, node $node is up"

# The documented job, smaller.
shards=5
what="--sets 1,7,19 --images 4"
grid="--grid 16"
sed -n '/^#!\/bin\/bash/,/^```/{/^```/!p}' "$project/docs/large-jobs.md" | sed \
  -e "s/--array=1-120/--array=1-$shards/" -e "s/shards=120/shards=$shards/" \
  -e "s/--cpus-per-task=4/--cpus-per-task=1/" -e "s/--mem=2G/--mem=200M/" \
  -e "s/--sets all --images 200/$what $grid/" >"$place/work/shearq.sh"
grep -q -- "$what" "$place/work/shearq.sh" || { echo "docs/large-jobs.md has no job to run"; exit 1; }
mkdir "$place/bin"
ln -s "$shearq" "$place/bin/shearq"
PATH=$place/bin:$PATH
cd "$place/work"

submit_and_wait() {
  local job
  job=$(sbatch --parsable "$@" shearq.sh)
  echo "job $job: sbatch $* shearq.sh"
  for _ in $(seq 300); do
    [ -n "$(squeue --noheader --job "$job" 2>/dev/null)" ] || return 0
    sleep 1
  done
  echo "the job does not end"; squeue; exit 1
}

shearq run --simulate $what $grid --submission 23/den/star --out whole >/dev/null
submit_and_wait
shearq merge run $what --shards $shards >merged.txt
diff -r whole run
echo "the folder of $shards shards is that of one process, byte for byte"

# Two lost results of two shards: merge names the shards, and these make it whole.
rm run/set01/catalogue-002.parquet run/set19/catalogue-003.parquet
if shearq merge run $what --shards $shards >merged.txt; then
  echo "merge takes an incomplete folder for a complete one"; exit 1
fi
again=$(sed -n 's/^shards to run again: //p' merged.txt)
cat merged.txt
submit_and_wait --array="$again"
shearq merge run $what --shards $shards >merged.txt
diff -r whole run
echo "the folder is whole again"
