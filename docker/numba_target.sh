# To be sourced by sh: kernels compiled after it load on other processors too, of an image or of a cluster.
#
# numba keeps a kernel for the processor that it was compiled on. With these variables of numba it compiles for any
# x86-64 with AVX2 (of 2015 and later, with exceptions), elsewhere for any of the architecture. The digits are the
# same. numba has one target for each process: kernels of your own in it are compiled for that one too.
if [ -z "${NUMBA_CPU_NAME+set}" ]; then
    if [ "$(uname -m)" = x86_64 ] && /lib64/ld-linux-x86-64.so.2 --help 2>/dev/null | grep -q 'x86-64-v3 (supported'; then
        export NUMBA_CPU_NAME=x86-64-v3
    else
        export NUMBA_CPU_NAME=generic
    fi
    export NUMBA_CPU_FEATURES=
fi
