// A renderer without a graphics card draws aside, and its picture is laid on the page once it is done. A canvas that it draws on
// by itself holds the page up for as long as a picture takes, and with it whoever holds the pad.

const SHARE = 0.4; // of the time that drawing takes at most: what holds the pad, and a robot simulated on this machine, want it, too
const LOOK_MS = 10; // between two looks whether the picture is done

export class Paper {
  /**
   * @param {HTMLCanvasElement} canvas of the page
   * @param {WebGL2RenderingContext} gl of a canvas that is not on it, and of the same size
   */
  constructor(canvas, gl) {
    this.canvas = canvas;
    this.gl = gl;
    this.context = canvas.getContext("2d", { alpha: false });
    this.buffer = gl.createBuffer();
    this.image = null;
  }

  /** Lay what was just drawn on the page; done when it is there and the next one may be drawn. */
  async lay() {
    const began = performance.now();
    const { gl, buffer } = this;
    const { width, height } = gl.canvas;
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.bufferData(gl.PIXEL_PACK_BUFFER, 4 * width * height, gl.STREAM_READ);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, 0);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    do await passed(LOOK_MS);
    while (!gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED);
    gl.deleteSync(fence);
    if (!gl.isContextLost()) this.fetch(width, height);
    await passed((performance.now() - began) * (1 / SHARE - 1));
  }

  fetch(width, height) {
    const { gl, buffer, canvas, context } = this;
    const rows = new Uint8Array(4 * width * height); // from below
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, rows);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    if (this.image?.width !== width || this.image.height !== height) this.image = new ImageData(width, height);
    for (let row = 0; row < height; row++) {
      this.image.data.set(rows.subarray(4 * width * (height - 1 - row), 4 * width * (height - row)), 4 * width * row);
    }
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    context.putImageData(this.image, 0, 0);
  }
}

function passed(ms) {
  return new Promise((done) => setTimeout(done, ms));
}
