//! Signals as NPY files: `<f8`, Fortran order, shape `[samples, channels]`.
