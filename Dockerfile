# syntax=docker/dockerfile:1
# Not built where this file was written (no container engine there); `docker build .` is the check.

FROM rust:1.95-slim-bookworm AS build
WORKDIR /src
# Dependencies first, so that a change of our own code does not build them again.
COPY Cargo.toml Cargo.lock rust-toolchain.toml ./
RUN mkdir -p src && echo 'fn main() {}' > src/main.rs && echo '' > src/lib.rs \
    && cargo build --release --locked && rm -rf src
COPY . .
RUN touch src/main.rs src/lib.rs && cargo build --release --locked --bin rigcast

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
ENTRYPOINT ["rigcast"]
CMD ["serve"]
