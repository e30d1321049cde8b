"""Versions in results."""

import subprocess

from mgs import provenance
from mgs.provenance import versions


def test_a_checkout_tells_its_commit(monkeypatch, tmp_path):
    def git(*words):
        who = ["-c", "user.name=nobody", "-c", "user.email=nobody@example.org"]
        command = ["git", "-C", tmp_path, *who, *words]
        return subprocess.check_output(command, text=True, stderr=subprocess.DEVNULL).strip()

    def told():
        provenance._commit.cache_clear()
        return versions().get("commit")

    (tmp_path / "mgs").mkdir()
    (tmp_path / "mgs/provenance.py").write_text("")
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "mgs/provenance.py"))
    assert told() is None
    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "begun")
    commit = git("rev-parse", "--short=7", "HEAD")
    assert told() == commit
    (tmp_path / "mgs/provenance.py").write_text("changed")
    assert told() == f"{commit}+"
    monkeypatch.setenv("PATH", "")  # no git
    assert told() is None
    provenance._commit.cache_clear()
