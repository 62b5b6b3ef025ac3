# MuJoCo is compiled and comes without stubs, so pyright sees none of its names; here it is told that they are untyped.
from typing import Any

def __getattr__(name: str) -> Any: ...
