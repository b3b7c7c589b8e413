"""The attacks of ``make attacks`` on blocks, few and short; LODGS_KILLS=10 asks for all of them."""

import os
import random

import pytest

pytest.importorskip("distributed")

KILLS = int(os.environ.get("LODGS_KILLS", "0"))


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.skipif(os.name == "nt", reason="processes have no groups and no SIGKILL")
def test_workers_that_are_killed_cost_no_bit(tmp_path):
    from tools.attacks_blocks import STEPS, Bench

    made = Bench(tmp_path, random.Random(KILLS), STEPS if KILLS else (150, 200, 500))
    try:
        found = {"kills": made.kill_all(KILLS) if KILLS else made.kill_all(1, once=())}
        if KILLS:
            found |= {on: made.stop(on) for on in ("here", "local:2", made.cluster.address)}
            if os.geteuid() == 0:
                found["disk"] = made.fill_disk()
    finally:
        made.cluster.close()
    print(found)
    assert not any(each["wrong"] for each in found.values()), found
