"""The option --resume of `solve`, which has no effect any more."""

from __future__ import annotations

from builders import build_history, build_solution, write_trial


def test_resume_says_that_it_does_nothing_and_what_was_kept_goes(run, monkeypatch, tmp_path):
    asked = []

    def solve(trial, **options):
        asked.append(options.keys())
        return (solution := build_solution()), build_history(solution)

    module = "factorgraph_dvl.solvers.information_along_trial"
    monkeypatch.setattr(f"{module}.solve_with_history", solve)
    trial, out = write_trial(tmp_path / "records"), tmp_path / "solved" / "out"
    kept = tmp_path / "solved" / ".out.factorgraph-dvl" / "stages"
    kept.mkdir(parents=True)
    (kept / "mounting.msgpack").write_bytes(b"of an earlier version")
    given = ("solve", trial, "--out", out, "--no-figures", "--force")
    plain = run(*given)
    assert plain.code == 0, plain.err
    assert [p.name for p in out.parent.iterdir()] == ["out"]
    assert "--resume" not in plain.err
    result = run(*given, "--resume")
    assert result.code == 0
    assert "--resume has no effect any more" in " ".join(result.err.split())
    assert asked[0] == asked[1]
