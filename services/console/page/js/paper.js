// Asynchronous display for software rendering: the renderer draws off-screen, and the finished picture is copied to the page.
// Drawing directly on the page's canvas would block the page, and the pad with it, for the duration of a picture.

const SHARE = 0.4; // maximum share of time for drawing; the pad and a simulator on the same machine also need the CPU
const LOOK_MS = 10; // period of the check whether the picture is finished

export class Paper {
  /**
   * @param {HTMLCanvasElement} canvas canvas on the page
   * @param {WebGL2RenderingContext} gl context of an off-screen canvas of the same size
   */
  constructor(canvas, gl) {
    this.canvas = canvas;
    this.gl = gl;
    this.context = canvas.getContext("2d", { alpha: false });
    this.buffer = gl.createBuffer();
    this.image = null;
  }

  /** Copy the picture that was just drawn to the page; resolves when the next picture may be drawn. */
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
    const rows = new Uint8Array(4 * width * height); // from bottom to top
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
