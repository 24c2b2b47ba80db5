"""Corpus: failures kept as regression scenarios, each a file, and what another ego does in them."""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from rare_envs.study.corpus.storage import add_run, read_corpus, read_run
    from rare_envs.study.corpus.stored_failure import StoredFailure
    from rare_envs.study.corpus.trial import EgoChoice, Trial, try_ego

__all__ = ["EgoChoice", "StoredFailure", "Trial", "add_run", "read_corpus", "read_run", "try_ego"]

_LAZY = {
    "EgoChoice": "rare_envs.study.corpus.trial",
    "StoredFailure": "rare_envs.study.corpus.stored_failure",
    "Trial": "rare_envs.study.corpus.trial",
    "add_run": "rare_envs.study.corpus.storage",
    "read_corpus": "rare_envs.study.corpus.storage",
    "read_run": "rare_envs.study.corpus.storage",
    "try_ego": "rare_envs.study.corpus.trial",
}

__getattr__ = make_lazy_getattr(__name__, _LAZY)
