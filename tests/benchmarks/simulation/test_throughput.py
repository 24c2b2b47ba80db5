from benchmarks.simulation import throughput


def test_the_highway_is_measured_against_highway_env():
    row = throughput.measure_highway(batch=2, rounds=1)
    assert row["ratio"] == row["per_second"] / row["reference_per_second"] > 0
    assert {f"highway_{batch}" for batch in throughput.REAL_TIME} < set(throughput.FLOORS)
    assert throughput.highway_memory(rollouts=8)["peak_gib"] < throughput.MEMORY_LIMIT


def test_the_camera_is_measured_against_lidar():
    row = throughput.measure_camera(batch=2, rounds=1)
    assert row["slow_down"] == row["lidar_per_second"] / row["per_second"] > 0
