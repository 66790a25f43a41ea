# syntax=docker/dockerfile:1
# Images for CPUs, from the lists of this repository:
#
#     docker build --target predict --tag phd_exp .
#     docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/data" phd_exp predict run=run.zip image=photo.jpg f=1550
#
#     docker build --target render --tag phd_exp:render .     # all extras, and Blender with its X libraries
#     docker build --target check .                           # both commands of the README
#
# For GPUs, leave out the index of CPU wheels.

FROM python:3.11-slim AS base
# of two wheels of one release, pip prefers the one with +cpu
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu \
    PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore

FROM base AS predict
# such as --build-arg EXTRAS=[report,video,export]
ARG EXTRAS=
WORKDIR /phd_exp
COPY pyproject.toml README.md constraints.txt ./
COPY conf conf
COPY hydra_plugins hydra_plugins
COPY phd_exp phd_exp
RUN pip install --constraint constraints.txt ".${EXTRAS}"
# compiled here, since a container has no earlier call of fuse and track; any user may add to it
ENV NUMBA_CACHE_DIR=/var/cache/numba
RUN python -m phd_exp.fusion && chmod --recursive a+rwX "$NUMBA_CACHE_DIR"
RUN useradd --create-home user
USER user
WORKDIR /data
ENTRYPOINT ["phd-exp"]

FROM base AS render
RUN apt-get update && apt-get install --yes --no-install-recommends make \
    libx11-6 libxext6 libxfixes3 libxi6 libxrender1 libxkbcommon0 libsm6 libice6 libgl1 \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /phd_exp
COPY . .
RUN make install
ENTRYPOINT [".venv/bin/phd-exp"]

FROM render AS check
RUN make demo
RUN make test
