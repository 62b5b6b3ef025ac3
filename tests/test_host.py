"""Host functions that fill XLA's own buffers: the same inside `jit`, `scan` and `vmap`, on a CPU and elsewhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.engines.host import filled


def double_and_negate(out, number, flag) -> None:
    doubled, negated = out["doubled"], out["negated"]
    doubled[:] = 2 * number
    negated[:] = ~flag


def shapes(number, flag):
    return {
        "doubled": jax.ShapeDtypeStruct(number.shape, number.dtype),
        "negated": jax.ShapeDtypeStruct(flag.shape, flag.dtype),
    }


def called(number, flag):
    return filled(double_and_negate, shapes(number, flag), number, flag)


@pytest.fixture(params=["cpu", "elsewhere"])
def anywhere(request, monkeypatch):
    """The way on a CPU, and that of devices whose memory the host cannot reach."""
    if request.param == "elsewhere":
        monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, cpu, default: default(*args))


@pytest.mark.usefixtures("anywhere")
def test_inside_jit_scan_and_vmap():
    number, flag = jnp.arange(6.0).reshape(2, 3), jnp.array([[True, False], [False, False]])
    for function in (called, jax.jit(called), jax.jit(jax.vmap(called))):
        found = function(number, flag)
        np.testing.assert_array_equal(found["doubled"], 2 * number)
        np.testing.assert_array_equal(found["negated"], ~flag)

    def again(carry, _):
        found = called(*carry)
        return (found["doubled"], found["negated"]), found["doubled"].sum()

    (doubled, negated), sums = jax.jit(lambda carry: jax.lax.scan(again, carry, None, length=5))((number, flag))
    np.testing.assert_array_equal(doubled, 32 * number)
    np.testing.assert_array_equal(negated, ~flag)
    np.testing.assert_array_equal(sums, number.sum() * 2.0 ** np.arange(1, 6))


@pytest.mark.usefixtures("anywhere")
def test_what_is_raised_is_told():
    def refuse(out, x) -> None:
        raise ValueError("no room left")

    with pytest.raises(Exception, match="no room left"):
        jax.block_until_ready(jax.jit(lambda x: filled(refuse, jax.ShapeDtypeStruct((2,), x.dtype), x))(jnp.zeros(2)))


def test_nothing_is_copied_on_a_cpu():
    """What goes in and comes out is where XLA has it: writing to the output is all there is to do."""
    places = {}

    def look(out, x) -> None:
        places["in"], places["out"] = x.__array_interface__["data"][0], out.__array_interface__["data"][0]
        out[:] = x

    x = jnp.arange(1024.0)
    y = jax.block_until_ready(jax.jit(lambda x: filled(look, jax.ShapeDtypeStruct(x.shape, x.dtype), x))(x))
    assert places == {"in": x.unsafe_buffer_pointer(), "out": y.unsafe_buffer_pointer()}
