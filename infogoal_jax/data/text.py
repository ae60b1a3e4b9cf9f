"""Goals given as text: sentence embeddings, kept in one file with the texts they belong to.

The paper's text goals are names of objects ("Coca-Cola glass bottle") seen through SBERT, all-MiniLM-L6-v2, 384-D.
The embeddings of the objects of the Active Vision Dataset are shipped, so that nothing but numpy is needed to
use them; `sentence_encoder` embeds other texts.
"""

import dataclasses
import difflib
import os
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from infogoal_jax.data import archives
from infogoal_jax.data.members import Member, read_file
from infogoal_jax.errors import UserError

EMBEDDING_SIZE = 384
SHIPPED_FILE = Path(__file__).parent / "files" / "text_embeddings.npz"
OWN_FILE = "my_embeddings.npz"

_SCHEMA = {
    "texts": Member("text", ("texts",)),
    "vectors": Member("float32", ("texts", EMBEDDING_SIZE)),
    "weights_sha256": Member("text", ()),
    "model": Member("text", ()),
}


@dataclasses.dataclass(frozen=True)
class TextEmbeddings:
    """M texts and their sentence embeddings, all from the same weights: those of others do not share a space. Raises
    `UserError` where the parts do not belong together, or a vector is not finite or not of length 1."""

    texts: tuple[str, ...]
    """As they were given to the encoder."""
    vectors: np.ndarray
    """float32 [M, 384], each of length 1; read-only."""
    weights_sha256: str
    """Checksum of the weights file."""
    model: str
    """Its name."""

    def __post_init__(self):
        vectors = np.array(self.vectors, np.float32)
        if vectors.shape != (len(self.texts), EMBEDDING_SIZE):
            raise UserError(
                f"text embeddings of {len(self.texts)} texts must have the shape "
                f"({len(self.texts)}, {EMBEDDING_SIZE}), not {vectors.shape}"
            )
        # Written so that NaN fails too.
        if not np.all(np.abs(np.linalg.norm(vectors, axis=1) - 1.0) < 1e-3):
            raise UserError("text embeddings must be finite vectors of length 1")
        vectors.flags.writeable = False
        object.__setattr__(self, "vectors", vectors)


def clean(text: str) -> str:
    """The text as it goes into the encoder: underscores, as in names of data sets, become spaces; no double spaces."""
    return " ".join(text.replace("_", " ").split())


def load_shipped() -> TextEmbeddings:
    """The embeddings that come with the package: 33 objects of the Active Vision Dataset, 34 spellings.

    The paper writes "Coca-Cola glass bottle" where the data set has coca_cola_glass_bottle; both are there.
    """
    return load(SHIPPED_FILE)


def load(path: str | os.PathLike) -> TextEmbeddings:
    """Read a file of text embeddings written by `save`. Raises `UserError` where there is none, or it is damaged."""
    again = "take it away and make it again" if Path(path).exists() else "make it"
    remedy = f"{again}: infogoal data embed 'a red mug' --out {shlex.quote(str(path))}"
    with archives.naming("text embeddings", path, remedy):
        texts, vectors, weights_sha256, model = read_file(path, _SCHEMA, remedy).values()
        return TextEmbeddings(tuple(texts.tolist()), vectors, str(weights_sha256), str(model))


def save(path: str | os.PathLike, embeddings: TextEmbeddings) -> None:
    """Writes text embeddings to an npz file. The file at `path` is always whole: the old one or the new one."""
    members = {field: np.asarray(getattr(embeddings, field)) for field in _SCHEMA}
    archives.save(path, members | {"texts": np.array(embeddings.texts, dtype=np.str_)}, "text embeddings")


def merge(first: TextEmbeddings, *others: TextEmbeddings) -> TextEmbeddings:
    """All texts of all arguments, in order; of a text that comes twice, the first. Raises `UserError` for embeddings of
    different weights."""
    vectors = {}
    for embeddings in (first, *others):
        if embeddings.weights_sha256 != first.weights_sha256:
            raise UserError(
                f"text embeddings of different weights cannot be mixed: {first.model} (sha256 {first.weights_sha256}) "
                f"and {embeddings.model} (sha256 {embeddings.weights_sha256})"
            )
        for text, vector in zip(embeddings.texts, embeddings.vectors, strict=True):
            vectors.setdefault(text, vector)
    return dataclasses.replace(
        first, texts=tuple(vectors), vectors=np.reshape(list(vectors.values()), (-1, EMBEDDING_SIZE))
    )


def embed_known(
    texts: Sequence[str], embeddings: TextEmbeddings | None = None, flag: str = "--env.text-embeddings"
) -> np.ndarray:
    """Look up the embeddings of N known texts, float32 [N, 384], each of length 1.

    Case, repeated white space, and underscores or hyphens in place of spaces make no difference, except where the file
    has both spellings: then the closer one is taken ("Coca-Cola glass bottle" and "coca cola glass bottle" are
    two texts to the encoder, cosine 0.99).
    embeddings: where to look; None: the shipped ones. flag: of the command line that another file is given by. Raises
    `UserError` for a text that is not there, with the closest known ones and the command that embeds it.
    """
    if isinstance(texts, str):
        raise UserError(f"embed_known takes a list of texts, not one text: [{texts!r}]")
    if embeddings is None:
        embeddings = load_shipped()
    exact, loose = {}, {}
    for row, text in enumerate(embeddings.texts):
        exact.setdefault(spelling(text), row)
        loose.setdefault(_without_hyphens(text), row)
    rows = [exact.get(spelling(text), loose.get(_without_hyphens(text))) for text in texts]
    unknown = list(dict.fromkeys(text for text, row in zip(texts, rows, strict=True) if row is None))
    if unknown:
        raise UserError(_unknown_message(unknown, texts, embeddings, loose, flag))
    return embeddings.vectors[np.array(rows, np.int64)]


def as_goal_inputs(embeddings: np.ndarray) -> np.ndarray:
    """Embeddings float32 [N, D] of length 1 as the goal encoder of embodied question answering takes them: networks
    want numbers of the order of 1."""
    return embeddings * np.float32(np.sqrt(embeddings.shape[1]))


def spelling(text: str) -> str:
    """What two texts have in common that the encoder cannot tell apart (it is uncased)."""
    return clean(text).lower()


def _without_hyphens(text: str) -> str:
    return spelling(text.replace("-", " "))


def _unknown_message(
    unknown: list[str], texts: Sequence[str], embeddings: TextEmbeddings, loose: dict[str, int], flag: str
) -> str:
    lines = []
    for text in unknown:
        closest = difflib.get_close_matches(_without_hyphens(text), loose, n=3, cutoff=0.5)
        names = ", ".join(repr(embeddings.texts[loose[name]]) for name in closest)
        lines.append(
            f"no embedding of the text {text!r} is known; " + (f"closest: {names}" if names else "none is close")
        )
    # All texts: the new file stands in place of the one that knows some of them.
    command = f"infogoal data embed {shlex.join(dict.fromkeys(texts))} --out {OWN_FILE}"
    return "\n".join([*lines, f"give {flag} {OWN_FILE}, which this makes: {command}"])
