import numba

from sfm_app.jit import kernel


def test_a_kernel_compiles_where_nothing_can_be_cached(monkeypatch):
    real = numba.njit

    def njit(*functions, **options):
        if options.get("cache"):
            raise RuntimeError("cannot cache function 'twice': no locator available")
        return real(*functions, **options)

    monkeypatch.setattr(numba, "njit", njit)

    @kernel
    def twice(x):
        return 2 * x

    assert twice(3.5) == 7.0
