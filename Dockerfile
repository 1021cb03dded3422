# One episode in a container: docker run --rm -v "$PWD/out:/out" mecanum-slam
FROM python:3.12-slim AS build
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir build && python -m build --wheel --outdir /wheels

FROM python:3.12-slim
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir /wheels/*.whl && rm -r /wheels \
    && useradd --uid 1000 --create-home robot && mkdir /out && chown robot /out
ENV NUMBA_CACHE_DIR=/home/robot/kernels
USER robot
WORKDIR /home/robot
# Compiles the kernels into the image: the first episode then starts at once.
RUN mecanum explore --agent ppo-frontier --rooms rectangular --out /tmp/warm && rm -r /tmp/warm
ENTRYPOINT ["mecanum"]
CMD ["explore", "--agent", "ppo-frontier", "--out", "/out"]
