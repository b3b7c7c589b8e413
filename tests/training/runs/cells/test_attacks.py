"""A short version of the attacks on cells of ``make attacks``; LODGS_KILLS=10 runs all of them."""

import os
import random

import pytest

pytest.importorskip("distributed")

KILLS = int(os.environ.get("LODGS_KILLS", "0"))


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.timeout(3000)
@pytest.mark.skipif(os.name == "nt", reason="needs process groups and SIGKILL")
def test_killed_workers_do_not_change_the_result(tmp_path):
    from tools.attacks_blocks import STEPS, BlockAttack

    attack = BlockAttack(tmp_path, random.Random(KILLS), STEPS if KILLS else (150, 200, 500))
    try:
        results = {"kills": attack.kill_all(KILLS) if KILLS else attack.kill_all(1, once=())}
        if KILLS:
            results |= {on: attack.stop(on) for on in ("here", "local:2", attack.cluster.address)}
            if os.geteuid() == 0:
                results["disk"] = attack.fill_disk()
    finally:
        attack.cluster.close()
    print(results)
    assert not any(result["wrong"] for result in results.values()), results
