"""Catalogues between processes, and numbers of threads."""

import concurrent.futures
import multiprocessing
import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import same_bits

import shearq

# More than joblib passes in a memory map.
GRID = 12


def measured(seed):
    image = shearq.simulate(set=8, seed=seed, grid=GRID)[0]
    return shearq.measure(image.stamps, image.psf, noise=image.noise)


def threads(_):
    return shearq.get_threads()


def received(catalogue):
    return type(catalogue).__name__, catalogue.attrs, catalogue.mean_shear()


@pytest.fixture(scope="module")
def one():
    return measured(3)


def check(one, found, sent):
    assert type(found) is shearq.Catalogue and found.attrs == one.attrs and same_bits(found, one)
    assert sent == ("Catalogue", one.attrs, one.mean_shear())


@pytest.mark.parametrize("start", ["spawn", "forkserver"])
def test_processes_of_multiprocessing_return_catalogues(one, start):
    context = multiprocessing.get_context(start)
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool:
        check(one, pool.submit(measured, 3).result(), pool.submit(received, one).result())
        expected = next((int(os.environ[n]) for n in ("SHEARQ_NUM_THREADS", "OMP_NUM_THREADS") if n in os.environ), 1)
        assert pool.submit(threads, 0).result() == expected


def test_jobs_of_joblib_return_catalogues(one):
    joblib = pytest.importorskip("joblib", reason="parallel jobs need joblib")
    large = np.concatenate([one] * 100)
    assert large.nbytes > 1 << 20
    jobs = [joblib.delayed(measured)(3), joblib.delayed(received)(one), joblib.delayed(received)(large)]
    found, sent, of_large = joblib.Parallel(2)(jobs)
    check(one, found, sent)
    assert of_large[2].galaxies == 100 * len(one)


@pytest.mark.parametrize("first", ["shearq", "distributed"])
def test_workers_of_dask_return_catalogues_whichever_is_imported_first(first, tmp_path):
    pytest.importorskip("distributed", reason="workers of dask need distributed")
    (tmp_path / "tasks.py").write_text(TASKS)
    script = f"import {first}\n{CLUSTER}"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=tmp_path, timeout=300
    )
    assert done.returncode == 0 and "passed" in done.stdout, done.stderr[-3000:]


TASKS = """
import numpy as np
import shearq

def measured(seed):
    image = shearq.simulate(set=8, seed=seed, grid=12)[0]
    return shearq.measure(image.stamps, image.psf, noise=image.noise)

def received(catalogue):
    return type(catalogue).__name__, catalogue.attrs, catalogue.mean_shear()

def of_block(stamps, psf):
    return shearq.measure(stamps, psf, noise=1.0)
"""

CLUSTER = """
if __name__ == "__main__":
    import numpy as np, shearq, tasks
    import dask.array
    from distributed import Client, LocalCluster
    one = tasks.measured(3)
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        scattered = client.scatter(one)
        for found in (
            client.submit(tasks.measured, 3).result(),
            scattered.result(),
            client.submit(np.asanyarray, scattered).result(),
        ):
            assert type(found) is shearq.Catalogue and found.attrs == one.attrs, type(found)
            assert np.array_equal(found["e1"], one["e1"])
        assert client.submit(tasks.received, one).result() == ("Catalogue", one.attrs, one.mean_shear())
        assert client.submit(shearq.get_threads).result() == 1
        image = shearq.simulate(set=8, seed=3, grid=12)[0]
        stamps = dask.array.from_array(image.stamps, chunks=(72, 48, 48))
        blocks = stamps.map_blocks(tasks.of_block, image.psf, drop_axis=(1, 2), dtype=one.dtype, meta=one[:0])
        found = blocks.compute()
        assert type(found) is shearq.Catalogue and found.mean_shear().galaxies == 144
        halves = [tasks.of_block(image.stamps[k : k + 72], image.psf) for k in (0, 72)]
        assert found.mean_shear() == shearq.mean_shear(halves)
    print("passed")
"""


def test_threads_are_those_of_the_argument_the_process_or_the_environment(monkeypatch):
    for name in ("SHEARQ_NUM_THREADS", "RAYON_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    assert shearq.get_threads() == len(os.sched_getaffinity(0))
    for name, text, expected in (
        ("OMP_NUM_THREADS", "3,2", 3),
        ("RAYON_NUM_THREADS", "4", 4),
        ("SHEARQ_NUM_THREADS", "5", 5),
    ):
        monkeypatch.setenv(name, text)
        assert shearq.get_threads() == expected
    shearq.set_threads(6)
    try:
        assert shearq.get_threads() == 6
    finally:
        shearq.set_threads(None)
    assert shearq.get_threads() == 5
    monkeypatch.setenv("SHEARQ_NUM_THREADS", "many")
    with pytest.raises(ValueError, match="SHEARQ_NUM_THREADS: found 'many'"):
        shearq.get_threads()
    with pytest.raises(ValueError, match="threads: found 0"):
        shearq.set_threads(0)


STARTED = """
import os, threading, time, shearq
image = shearq.simulate(set=8, grid=40)[0]
most = 0
done = threading.Event()
def watch():
    global most
    while not done.is_set():
        most = max(most, len(os.listdir("/proc/self/task")))
        time.sleep(1e-3)
watcher = threading.Thread(target=watch)
watcher.start()
before = len(os.listdir("/proc/self/task"))
for _ in range(5):
    shearq.measure(image.stamps, image.psf, noise=1.0)
done.set(); watcher.join()
print(most - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted as Linux lists them")
def test_as_many_threads_are_started_as_the_environment_says():
    counts = []
    for number in ("1", "7"):
        environment = {**os.environ, "SHEARQ_NUM_THREADS": number}
        done = subprocess.run([sys.executable, "-c", STARTED], capture_output=True, text=True, check=True, env=environment)
        counts.append(int(done.stdout))
    # The work has several stages, and a short thread may end before it is seen.
    assert counts[0] < 4 < counts[1], counts
