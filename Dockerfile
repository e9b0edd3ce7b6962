# syntax=docker/dockerfile:1
# `tests/manifest.rs` runs the build stage's steps without a container engine, up to the compiler.

FROM rust:1.95-slim-bookworm AS build
WORKDIR /src
# Dependencies first: a change of the program's own code does not compile them again. Cargo wants a file for
# every target that the manifest names, so the program, its benches and its example are empty here.
COPY Cargo.toml Cargo.lock ./
COPY src/engine/Cargo.toml src/engine/Cargo.toml
COPY src/engine/numerics/Cargo.toml src/engine/numerics/Cargo.toml
RUN mkdir -p src benches/http examples/blind_check \
    && touch src/lib.rs src/engine/mod.rs src/engine/numerics/mod.rs \
    && for target in src benches/http examples/blind_check; do echo 'fn main() {}' > $target/main.rs; done \
    && cp src/main.rs benches/engine.rs \
    && cargo build --release --locked --bin rigcast
COPY build.rs openapi.yaml ./
COPY migrations migrations
COPY src src
# The commit that models name as their maker: docker build --build-arg COMMIT=$(git rev-parse --short=12 HEAD) .
ARG COMMIT=
RUN touch src/main.rs src/lib.rs src/engine/mod.rs src/engine/numerics/mod.rs && RIGCAST_COMMIT=$COMMIT cargo build --release --locked --bin rigcast

FROM debian:bookworm-slim
RUN useradd --system --uid 10001 --home-dir /data --create-home rigcast
COPY --from=build /src/target/release/rigcast /usr/local/bin/rigcast
USER rigcast
WORKDIR /data
VOLUME /data
ENV RIGCAST_DATA_DIR=/data RIGCAST_LOG_FORMAT=json
EXPOSE 8080
# Loopback by default. To be reached from outside the container the service needs an admin's token first:
#   docker run --rm -v rigcast:/data rigcast token create --role admin
#   docker run -v rigcast:/data -p 8080:8080 -e RIGCAST_LISTEN=0.0.0.0:8080 rigcast
HEALTHCHECK --interval=30s --timeout=5s --start-period=60s CMD ["rigcast", "health"]
ENTRYPOINT ["rigcast"]
CMD ["serve"]
