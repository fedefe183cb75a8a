import subprocess
import sys
import time

import shortfinal as sf

FRESH = """
import sys, time
start = time.perf_counter()
import shortfinal
took = time.perf_counter() - start
assert 'torch' not in sys.modules
import shortfinal.pipeline, shortfinal.demo, shortfinal.cli, shortfinal.audit, shortfinal.stream.source
assert 'torch' not in sys.modules, 'something outside train imports torch'
print(took)
"""


def test_import_is_quick_and_without_torch():
    start = time.perf_counter()
    out = subprocess.run([sys.executable, "-c", FRESH], capture_output=True, text=True, check=True).stdout
    assert float(out) < min(1.0, time.perf_counter() - start)


def test_every_name_that_is_listed_exists():
    for name in sf.__all__:
        assert getattr(sf, name) is not None
    assert sorted(dir(sf)) == sorted(sf.__all__)


def test_every_name_has_one_home():
    listed = {name for names in sf._HOME.values() for name in names}
    assert listed == set(sf.__all__) - {"__version__"}
