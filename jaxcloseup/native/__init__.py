"""The native library for CPUs: what XLA's loops are slow at, in C++.

`library` loads it; the modules that call its functions stand beside their twins in JAX, such as
`fields.splats.blend_native`.
"""
