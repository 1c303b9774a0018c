// The page with a stand-in for viewer and source, for tests of its controls: it draws a checkered room of its own.

import type { Header, SourceState } from "../src/core/types.ts";
import { readAddress } from "../src/page/address.ts";
import { meta } from "../src/page/dom.ts";
import { ViewPage } from "../src/page/view.ts";
import type { PageCamera, Pick, Statistics, ViewerLike, ViewerOptions } from "../src/page/viewer-like.ts";
