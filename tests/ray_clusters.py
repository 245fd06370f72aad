"""Clusters of this machine for tests of Ray: every node is a raylet of its own."""

import ray
from ray.cluster_utils import Cluster

STORE_BYTES = 100 << 20


def start_cluster(cpus):
    """Starts the head, with so many CPUs."""
    return Cluster(initialize_head=True, head_node_args={
        "num_cpus": cpus, "include_dashboard": False, "object_store_memory": STORE_BYTES})


def cluster_for(monkeypatch):
    """Yields a cluster of a head without CPUs, for a test to add nodes to; for fixtures."""
    made = start_cluster(cpus=0)
    monkeypatch.setenv("RAY_ADDRESS", made.address)
    yield made
    ray.shutdown()
    made.shutdown()


def node_of(process, nodes):
    """Returns the simulated node on which a process runs."""
    raylet = next(parent for parent in process.parents() if parent.name() == "raylet")
    return next(node for node in nodes
                if raylet.pid in [each.process.pid for each in node.all_processes["raylet"]])
