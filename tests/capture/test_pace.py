from recon_cli.capture import pace


def test_calls_are_let_through_seldom_but_the_last_one_always(monkeypatch):
    now = iter([0.0, 0.1, 0.49, 0.6, 0.7, 0.8])
    monkeypatch.setattr(pace.time, "monotonic", lambda: next(now))
    seen = []
    report = pace.paced(lambda done, total: seen.append((done, total)))
    for done in range(1, 7):
        report(done, 6)
    assert seen == [(1, 6), (4, 6), (6, 6)]
