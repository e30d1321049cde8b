// Pictures of a file of Gaussians from several poses by two viewers, two of each pose: a data URL of the
// canvas, and rows, from the lowest up, of RGBA in bits of half floats, blended as such. projection,
// poses: 16 numbers of the matrices of OpenGL, column by column; poses are camera to world.

// Picture once it differs from the one before `show` and has not changed for two seconds: splats are
// sorted beside the drawing.
async function settled(picture, show) {
  const blank = await picture();
  let last = blank;
  show();
  for (let same = 0; same < 4; ) {
    await new Promise((done) => setTimeout(done, 500));
    const next = await picture();
    same = next === last && next !== blank ? same + 1 : 0;
    last = next;
  }
  return last;
}

export const sparkAsItComes = (...asked) => spark(...asked, false);

export async function spark(file, width, height, projection, poses, as3dgs = true) {
  const THREE = await import('three');
  const { SparkRenderer, SplatMesh } = await import('@sparkjsdev/spark');
  const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
  renderer.setSize(width, height);
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera();
  camera.projectionMatrix.fromArray(projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  // As 3DGS: sorted by depth instead of distance, and drawn to where alpha is 1/255 instead of 2.8
  // standard deviations. `ext`: 32 bytes a Gaussian instead of 16.
  const tails = { maxStdDev: Math.sqrt(2 * Math.log(255)), minAlpha: 1 / 255 };
  const patch = as3dgs ? { sortRadial: false, accumExtSplats: true, ...tails } : {};
  const drawer = new SparkRenderer({ renderer, ...patch });
  const mesh = new SplatMesh({ url: file, extSplats: as3dgs });
  await mesh.initialized;
  const picture = () => {
    renderer.render(scene, camera);
    return renderer.domElement.toDataURL();
  };
  THREE.ColorManagement.workingColorSpace = THREE.SRGBColorSpace;  // in which a target is blended
  const target = new THREE.WebGLRenderTarget(width, height, { type: THREE.HalfFloatType });
  const halves = new Uint16Array(4 * width * height), pictures = [];
  for (const pose of poses) {
    pictures.push(await settled(picture, () => {
      new THREE.Matrix4().fromArray(pose).decompose(camera.position, camera.quaternion, camera.scale);
      camera.updateMatrixWorld();
      scene.add(drawer, mesh);
    }));
    renderer.setRenderTarget(target);
    renderer.render(scene, camera);
    renderer.readRenderTargetPixels(target, 0, 0, width, height, halves);
    pictures.push(halves.join());
    renderer.setRenderTarget(null);
  }
  return pictures;
}

export async function playcanvas(file, width, height, projection, poses) {
  const pc = await import('playcanvas');
  const canvas = document.body.appendChild(document.createElement('canvas'));
  const graphicsDeviceOptions = { antialias: false, alpha: false, preserveDrawingBuffer: true };
  const app = new pc.Application(canvas, { graphicsDeviceOptions });
  app.setCanvasFillMode(pc.FILLMODE_NONE, width, height);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, width, height);
  app.start();
  // As 3DGS: antialiased, none too small, widened by 0.3 square pixels instead of 0.3 / 4, without
  // the lowered tail of each Gaussian, and to where alpha is 1/255 instead of 2.8 standard deviations.
  Object.assign(app.scene.gsplat, { antiAlias: true, minPixelSize: 0, dataFormat: pc.GSPLATDATA_LARGE });
  const chunks = pc.ShaderChunks.get(app.graphicsDevice, pc.SHADERLANGUAGE_GLSL);
  for (const [name, old, constant] of [
    ['gsplatCornerVS', '0.3', '1.2'],
    ['gsplatPS', '(exp(x * -4.0) - EXP4) * INV_EXP4', 'exp(x * -4.0)'],
    ['gsplatPS', 'A > 1.0', 'false'],
    ['gsplatCommonVS', 'min(1.0, sqrt(max(0.0, log(alpha / alphaClipValue))) * 0.5)',
      'sqrt(max(0.0, log(alpha / alphaClipValue))) * 0.5'],
  ]) {
    if (!chunks.get(name).includes(old)) throw Error(`${name} of this PlayCanvas has no ${old}`);
    chunks.set(name, chunks.get(name).replaceAll(old, constant));
  }
  const camera = new pc.Entity();
  camera.addComponent('camera', { clearColor: pc.Color.BLACK, toneMapping: pc.TONEMAP_NONE });
  camera.camera.calculateProjection = (target) => target.set(projection);
  app.root.addChild(camera);
  const scene = file.endsWith('.glb');
  const asset = new pc.Asset(file, scene ? 'container' : 'gsplat', { url: file });
  app.assets.add(asset);
  await new Promise((done, wrong) => {
    asset.ready(done);
    asset.on('error', wrong);
    app.assets.load(asset);
  });
  const model = scene ? asset.resource.instantiateRenderEntity() : new pc.Entity();
  if (!scene) model.addComponent('gsplat', { asset });
  app.autoRender = false;
  const drawn = async (picture) => {
    app.renderNextFrame = true;
    await new Promise((done) => app.once('frameend', done));
    return picture();
  };
  const pictures = [];
  for (const pose of poses) {
    pictures.push(await settled(() => drawn(() => canvas.toDataURL()), () => {
      const matrix = new pc.Mat4().set(pose);
      camera.setPosition(matrix.getTranslation());
      camera.setRotation(new pc.Quat().setFromMat4(matrix));
      if (!model.parent) app.root.addChild(model);
    }));
    const texture = { width, height, format: pc.PIXELFORMAT_RGBA16F, mipmaps: false };
    const colorBuffer = new pc.Texture(app.graphicsDevice, texture);
    const halves = async () => (await colorBuffer.read(0, 0, width, height)).join();
    pictures.push(await settled(() => drawn(halves), () => {
      camera.camera.renderTarget = new pc.RenderTarget({ colorBuffer, depth: true });
    }));
    camera.camera.renderTarget = null;
  }
  return pictures;
}
