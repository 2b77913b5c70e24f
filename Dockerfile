# A machine that has nothing but SCOPE; building it runs the tests: docker build -t scope .
# Then: docker run --rm -v "$PWD:/work" scope scan capture.toml --rig rig.json
FROM python:3.12-slim-bookworm
RUN apt-get update \
    && apt-get install -y --no-install-recommends git make libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6 libudev1 libidn2-0 \
    && rm -rf /var/lib/apt/lists/*
COPY . /scope
WORKDIR /scope
RUN make test
ENV PATH="/scope/.venv/bin:$PATH"
WORKDIR /work
ENTRYPOINT ["scope"]
CMD ["--help"]
