"""How kernels are compiled, kept and spread over threads; knows nothing of images.

May import: `errors` alone. For others: `jit.kernel`, `jit.bare`, `parallel.over_bands`,
`parallel.together`, `parallel.set_threads`.
"""
