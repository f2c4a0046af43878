"""The base of every settings model: frozen, and strict about names it does not know."""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """A frozen group of settings. An unknown key is an error, never ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid")
